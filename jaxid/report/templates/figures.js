"use strict";
// Draws the figures of this page with plotly, which the page holds in packed form.
(async () => {
  const charts = [...document.querySelectorAll(".chart")];
  const coarse = matchMedia("(hover: none)").matches;
  const grey = "#7b8794", faint = "rgba(123, 135, 148, 0.28)";
  const options = {
    displaylogo: false, responsive: false, scrollZoom: false,
    displayModeBar: true,
    modeBarButtons: [["toImage", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
    toImageButtonOptions: { format: "svg" },
  };

  const optionsOf = (chart) => (chart.content.frames ? { ...options, modeBarButtons: [["toImage", "resetCameraDefault3d"]] } : options);

  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  function axis(own) {
    const title = { ...own.title, font: { size: 12 }, standoff: 6 };
    const look = { gridcolor: faint, zeroline: false, linecolor: grey, automargin: true };
    return { ticks: "outside", ticklen: 3, tickcolor: grey, ...look, ...own, title };
  }

  function layoutOf(chart) {
    const own = chart.content.layout, layout = { ...own };
    for (const key of Object.keys(own)) if (/axis/.test(key)) layout[key] = axis(own[key]);
    if (own.scene) {
      const plane = { gridcolor: grey, zerolinecolor: grey, backgroundcolor: "rgba(0,0,0,0)" };
      layout.scene = { ...own.scene, dragmode: "turntable" };
      const { x, y, z } = own.scene.camera.eye, away = widthOf(chart) < 500 ? 1.35 : 1;
      layout.scene.camera = { eye: { x: away * x, y: away * y, z: away * z } };
      for (const key of ["xaxis", "yaxis", "zaxis"]) layout.scene[key] = { ...plane, ...own.scene[key] };
    }
    const margin = own.scene ? { l: 0, r: 0, t: 0, b: 0 } : { l: 52, r: 8, t: coarse ? 28 : 8, b: 40 };
    return {
      ...layout, margin, showlegend: false, dragmode: own.scene ? undefined : coarse ? false : "zoom",
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", modebar: { bgcolor: "rgba(0,0,0,0)" }, bargap: 0.2, barmode: "overlay",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: grey },
      width: widthOf(chart), height: parseFloat(chart.style.height),
    };
  }

  // On paper the width of a chart is not known before it is drawn.
  let paper = 0;
  function widthOf(chart) {
    if (!paper) return Math.max(chart.clientWidth, 200);
    const columns = Number(getComputedStyle(chart.closest(".panels")).getPropertyValue("--columns"));
    return columns > 1 ? paper / 2 - 12 : paper;
  }

  const same = (chart) => [...chart.closest("figure").querySelectorAll(".chart")];
  const drawn = (chart) => chart.classList.contains("drawn");

  function draw(chart) {
    if (drawn(chart)) return;
    chart.classList.add("drawn");
    const { data, frames } = chart.content;
    for (const trace of data) if (Number.isInteger(trace.x)) trace.x = data[trace.x].x;
    Plotly.newPlot(chart, data, layoutOf(chart), optionsOf(chart));
    for (const button of chart.closest("figure").querySelectorAll("[data-curve][aria-pressed=false]"))
      show(chart, button.dataset.curve, false);
    if (frames) animate(chart, frames); else chart.on("plotly_relayout", (change) => follow(chart, change));
    sizes.observe(chart);
  }

  function resize(chart) {
    const width = widthOf(chart);
    if (drawn(chart) && (paper || chart.clientWidth) && Math.abs(width - chart.layout.width) > 1)
      Plotly.relayout(chart, { width });
  }
  const sizes = new ResizeObserver((seen) => seen.forEach((entry) => paper || resize(entry.target)));

  // Panels of a figure have one abscissa: zooming one zooms all.
  let following = false;
  function follow(chart, change) {
    const keys = Object.keys(change).filter((key) => /^xaxis\.(range|autorange)/.test(key));
    if (following || !keys.length) return;
    following = true;
    const wanted = Object.fromEntries(keys.map((key) => [key, change[key]]));
    const others = same(chart).filter((other) => other !== chart && drawn(other));
    const alike = others.filter((other) => other.layout.xaxis.title.text === chart.layout.xaxis.title.text);
    Promise.all(alike.map((other) => Plotly.relayout(other, wanted))).then(() => { following = false; });
  }

  function show(chart, name, visible) {
    const found = chart.data.flatMap((trace, k) => (trace.legendgroup === name ? [k] : []));
    if (found.length) Plotly.restyle(chart, { visible }, found);
  }

  function press(button) {
    const visible = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(visible));
    const own = [...button.closest("figure").querySelectorAll(".chart")];
    if (button.dataset.curve !== undefined) own.filter(drawn).forEach((chart) => show(chart, button.dataset.curve, visible));
    else own[Number(button.dataset.panel)].closest(".panel").hidden = !visible;
  }
  for (const button of document.querySelectorAll(".legend button")) button.addEventListener("click", () => press(button));

  function animate(chart, frames) {
    const bar = document.createElement("div");
    bar.className = "player";
    bar.innerHTML = '<button type="button">play</button><input type="range" min="0" aria-label="time"><output></output>';
    const [button, slider, clock] = bar.children;
    slider.max = String(frames.time.length - 1);
    slider.value = "0";
    chart.after(bar);
    let timer = 0;
    function placed({ vertices, bodies, places }, k) {
      return [0, 1, 2].map((i) => vertices.map((v, n) => {
        const at = places[k][bodies[n]];
        return at ? at[4 * i] * v[0] + at[4 * i + 1] * v[1] + at[4 * i + 2] * v[2] + at[4 * i + 3] : v[i];
      }));
    }
    function pose(k) {
      const { x, y, z } = frames.points[k];
      const change = { x: [x], y: [y], z: [z] };
      if (frames.colours) change["line.color"] = [frames.colours[k]];
      clock.textContent = `${frames.time[k].toFixed(1)} s`;
      if (frames.solids) {
        const solid = placed(frames.solids, k);
        ["x", "y", "z"].forEach((axis, i) => change[axis].push(solid[i]));
        if (frames.colours) change["line.color"].push(undefined);
      }
      return Plotly.restyle(chart, change, frames.solids ? [1, 2] : [1]);
    }
    async function step() {
      if (!timer) return;
      slider.value = String((Number(slider.value) + 1) % frames.time.length);
      await pose(Number(slider.value));
      timer = setTimeout(step, 60);
    }
    button.addEventListener("click", () => {
      button.textContent = timer ? "play" : "pause";
      if (timer) { clearTimeout(timer); timer = 0; } else { timer = 1; step(); }
    });
    slider.addEventListener("input", () => pose(Number(slider.value)));
    pose(0);
  }

  function toPaper() {
    for (const part of document.querySelectorAll("details:not([open])")) { part.open = true; part.dataset.closed = ""; }
    paper = 690;
    charts.forEach((chart) => (drawn(chart) ? resize(chart) : draw(chart)));
  }
  function toScreen() {
    paper = 0;
    for (const part of document.querySelectorAll("details[data-closed]")) { part.open = false; delete part.dataset.closed; }
    charts.forEach(resize);
  }

  try {
    const code = document.createElement("script");
    code.textContent = await unpack(document.getElementById("library").textContent);
    document.head.append(code);
    await Promise.all(charts.map(async (chart) => { chart.content = JSON.parse(await unpack(chart.dataset.chart)); }));
  } catch (error) {
    charts.forEach((chart) => { chart.textContent = "This figure needs a browser of 2023 or later."; });
    throw error;
  }
  const near = new IntersectionObserver((seen) => seen.forEach((entry) => entry.isIntersecting && draw(entry.target)), { rootMargin: "600px" });
  charts.forEach((chart) => near.observe(chart));
  addEventListener("beforeprint", toPaper);
  addEventListener("afterprint", toScreen);
  document.documentElement.dataset.ready = "";
})();
