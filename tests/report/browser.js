// Functions that the tests call in the page.
async function drawAll() {
  document.querySelectorAll("details").forEach((part) => { part.open = true; });
  for (const chart of document.querySelectorAll(".chart")) {
    chart.scrollIntoView({ behavior: "instant" });
    for (let k = 0; k < 200 && !chart.classList.contains("drawn"); k++)
      await new Promise((next) => setTimeout(next, 20));
  }
  scrollTo({ top: 0, behavior: "instant" });
  await new Promise((next) => setTimeout(next, 300));
  return document.querySelectorAll(".chart:not(.drawn)").length;
}

function faults() {
  const faults = [], width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > width) faults.push("the page scrolls sideways");
  const visible = (x) => x.width > 0 && x.height > 0;
  const texts = document.querySelectorAll("h1, h2, p, dt, dd, li, summary, button, figcaption, .tiles b");
  for (const text of texts) {
    const box = text.getBoundingClientRect();
    if (!visible(box) || text.closest(".scroll")) continue;
    if (box.left < -0.5 || box.right > width + 0.5 || text.scrollWidth > text.clientWidth + 1 && text.clientWidth)
      faults.push(`cut off: ${text.textContent.trim().slice(0, 40)}`);
  }
  for (const chart of document.querySelectorAll(".chart.drawn")) {
    const frame = chart.getBoundingClientRect();
    const own = [...chart.querySelectorAll(".xtick text, .ytick text, .xtitle, .ytitle, .y2title")];
    const boxes = own.map((text) => [text.textContent, text.getBoundingClientRect()]);
    for (const [text, box] of boxes)
      if (visible(box) && (box.left < frame.left - 1 || box.right > frame.right + 1 || box.top < frame.top - 1 || box.bottom > frame.bottom + 1))
        faults.push(`cut off in ${chart.ariaLabel}: ${text}`);
    for (let i = 0; i < boxes.length; i++)
      for (let k = i + 1; k < boxes.length; k++) {
        const [a, b] = [boxes[i][1], boxes[k][1]];
        const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
        const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
        if (across > 2 && down > 3) faults.push(`overlap in ${chart.ariaLabel}: ${boxes[i][0]} and ${boxes[k][0]}`);
      }
  }
  return faults;
}

// Tables and figures on paper: no column is cut or narrower than its words.
function paperFaults() {
  dispatchEvent(new Event("beforeprint"));
  const faults = [], width = document.documentElement.clientWidth;
  for (const table of document.querySelectorAll("table"))
    if (table.getBoundingClientRect().right > width + 1) faults.push(`wider than the paper: ${table.textContent.trim().slice(0, 40)}`);
  for (const cell of document.querySelectorAll("td.code, th.code"))
    if (cell.clientWidth < 100) faults.push(`narrow: ${cell.textContent}`);
  for (const chart of document.querySelectorAll(".chart"))
    if (!(chart.querySelector(":scope > .sketch").getBoundingClientRect().height > 50)) faults.push(`empty: ${chart.ariaLabel}`);
  dispatchEvent(new Event("afterprint"));
  return faults;
}

const figures = () => [...document.querySelectorAll("figure")];
const torques = () => figures().find((f) => f.querySelector("[data-curve=measured]"));
const charts = () => [...torques().querySelectorAll(".chart")];
const ranges = () => charts().map((chart) => chart.layout.xaxis.range.map(Number));
const shown = () => charts().map((chart) => chart.data.filter((trace) => trace.visible !== false).length);
const robot = () => [...document.querySelectorAll(".chart")].find((chart) => chart.content.frames);

function firstPanel() {
  const box = charts()[0].querySelector(".nsewdrag");
  box.scrollIntoView({ behavior: "instant", block: "center" });
  const { x, y, width, height } = box.getBoundingClientRect();
  return [x + 0.25 * width, x + 0.75 * width, y + 0.5 * height];
}

function slide(frame) {
  const slider = robot().parentNode.querySelector("input");
  slider.value = String(frame);
  slider.dispatchEvent(new Event("input"));
  return JSON.stringify(robot().data[1].x);
}

function frameOfTheRobot() {
  robot().scrollIntoView({ behavior: "instant", block: "center" });
  const { x, y, width, height } = robot().getBoundingClientRect();
  return [x, y, width, height];
}

// Pixels that are drawn within 2 px of the left, right, top and bottom of the view.
async function colouredBorderPixels() {
  const scene = robot()._fullLayout.scene._scene;
  const picture = new Image();
  picture.src = scene.toImage("png");
  await picture.decode();
  const canvas = document.createElement("canvas"), { width, height } = picture;
  Object.assign(canvas, { width, height });
  const pen = canvas.getContext("2d");
  pen.drawImage(picture, 0, 0);
  const strips = [[0, 0, 2, height], [width - 2, 0, 2, height], [0, 0, width, 2], [0, height - 2, width, 2]];
  return strips.map((strip) => pen.getImageData(...strip).data.filter((value, k) => k % 4 === 3 && value > 30).length);
}
