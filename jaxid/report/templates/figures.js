"use strict";
// Draws the figures of this page with plotly, which the page holds in packed form.
// Until it is unpacked, and on paper, `sketches` shows them.
(async () => {
  const charts = [...document.querySelectorAll(".chart")];
  const coarse = matchMedia("(hover: none)").matches;
  const grey = "#7b8794", pale = "#d5dae0", sky = "#3d9bd6", faint = "rgba(123, 135, 148, 0.28)";
  const fromSmallToLarge = [[0, sky], [0.5, "#c27d00"], [1, "#d55e00"]];
  const labelRoom = [0.78, 0.88]; // share of width and height that the axes fill, labels beside them
  const gap = 0.05; // between panels with one abscissa, relative to their height
  const options = {
    displaylogo: false, responsive: false, scrollZoom: false,
    displayModeBar: true,
    modeBarButtons: [["toImage", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
    toImageButtonOptions: { format: "svg" },
  };

  const optionsOf = (chart) => (chart.content.frames ? { ...options, modeBarButtons: [["toImage", "zoom3d", "pan3d", "tableRotation", "resetCameraLastSave3d"]] } : options);
  const escaped = (text) => text.replace(/[&<>"']/g, (letter) => `&#${letter.charCodeAt(0)};`);

  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

  // Numbers come in single precision.
  function numbers(key, value) {
    return value?.floats === undefined ? value : new Float32Array(bytesOf(value.floats));
  }

  const looks = {
    line: ({ colour, width, dashed, marker }) => ({
      mode: marker ? "lines+markers" : "lines", marker: { size: 4 },
      line: { color: colour, width: 0.4 + width, dash: dashed ? "dash" : "solid" },
    }),
    points: ({ colour }) => ({ mode: "markers", marker: { color: colour, size: 7, line: { color: grey, width: 1 } } }),
    bars: ({ colour, width }) => ({ type: "bar", width, marker: { color: colour }, textposition: "none" }),
    band: ({ x, low, high, colour }) => ({
      mode: "lines", x: [...x, ...[...x].reverse()], y: [...high, ...[...low].reverse()],
      fill: "toself", fillcolor: colour, line: { width: 0 }, opacity: 0.35, hoverinfo: "skip", hovertemplate: undefined,
    }),
    intervals: ({ x, low, high, colour }) => ({
      mode: "markers", marker: { color: colour, size: 7 },
      error_x: {
        type: "data", symmetric: false, width: 0, thickness: 1.6, color: colour,
        array: high.map((end, k) => end - x[k]), arrayminus: low.map((end, k) => x[k] - end),
      },
    }),
  };

  // Names of joints may be long: two of them may differ only in the middle.
  const folded = (name) => name.match(/.{1,20}/g).map(escaped).join("<br>");

  const axisNumber = (panel) => (panel ? String(panel + 1) : "");

  function traceOf(curve, { panels }) {
    const panel = panels[curve.panel], label = escaped(curve.name || panel.y || panel.title);
    const hover = curve.texts.length ? "%{text}" : `${label}: %{y:.4~g} ${escaped(panel.unit)}`;
    return {
      type: "scatter", name: label, legendgroup: curve.name, x: curve.x, y: curve.y, yaxis: `y${axisNumber(curve.panel)}`,
      text: curve.texts.map(escaped), hovertemplate: `${hover}<extra></extra>`, ...looks[curve.kind](curve),
    };
  }

  function axis(label, range, logarithmic, names) {
    // A phone has room for about fifty letters.
    const text = escaped(label).replace(/(.{36,}?) /g, "$1<br>");
    const title = { text, font: { size: 12 }, standoff: 6 };
    const look = { gridcolor: faint, zeroline: false, linecolor: grey, automargin: true };
    return {
      ticks: "outside", ticklen: 3, tickcolor: grey, ...look, title,
      ...(logarithmic && { type: "log", exponentformat: "power" }),
      ...(range && { range: logarithmic ? range.map(Math.log10) : range }),
      ...(names.length && { tickvals: [...names.keys()], ticktext: names.map(folded), autotickangles: [0, 90] }),
    };
  }

  function axesOf(panels) {
    const [{ x, x_range, log, x_names }] = panels, total = panels.reduce((sum, panel) => sum + panel.share, 0);
    const axes = { xaxis: { ...axis(x, x_range, log.includes("x"), x_names), anchor: `y${axisNumber(panels.length - 1)}` } };
    let top = 1;
    panels.forEach((panel, k) => {
      const bottom = Math.max(0, top - panel.share / total), names = panel.y_names;
      axes[`yaxis${axisNumber(k)}`] = {
        ...axis(panel.y_label, undefined, panel.log.includes("y"), names), domain: [k + 1 < panels.length ? bottom + gap : 0, top],
        ...(names.length && { range: [names.length - 0.4, -0.6] }), ...(panel.share < 1 && { nticks: 4 }),
      };
      top = bottom;
    });
    return axes;
  }

  function levelOf([which, value, colour], panel) {
    const line = { color: colour, width: 1, dash: value ? "dash" : "solid" }, y = `y${axisNumber(panel)}`;
    const across = which === "x" ? { x0: value, x1: value, y0: 0, y1: 1 } : { x0: 0, x1: 1, y0: value, y1: value };
    const axes = which === "x" ? { xref: "x", yref: `${y} domain` } : { xref: "x domain", yref: y };
    return { type: "line", layer: "below", line, ...across, ...axes };
  }

  function panelsOf({ panels, curves }) {
    const lines = curves.every((curve) => curve.kind === "line" || curve.kind === "band");
    const shapes = panels.flatMap((panel, k) => panel.levels.map((level) => levelOf(level, k)));
    return { ...axesOf(panels), shapes, hovermode: lines || panels[0].x_names.length ? "x" : "closest" };
  }

  // Vertices of the shapes at a frame, one list for each axis; the ground has no place.
  function placed({ vertices, bodies, places }, frame) {
    return [0, 1, 2].map((i) => vertices.map((v, n) => {
      const at = bodies[n] < 0 ? null : places[frame].subarray(12 * bodies[n]);
      return at ? at[4 * i] * v[0] + at[4 * i + 1] * v[1] + at[4 * i + 2] * v[2] + at[4 * i + 3] : v[i];
    }));
  }

  // The path of the end-effector, the robot and the shapes around it.
  function bodiesOf({ path, mean, label, largest, frames }) {
    const scale = largest === null ? {} : { colorscale: fromSmallToLarge, cmin: 0, cmax: largest };
    const title = { text: escaped(label), side: "top" };
    const colorbar = { title, thickness: 10, orientation: "h", len: 0.6, y: 0, yanchor: "bottom" };
    const trace = { type: "scatter3d", hoverinfo: "skip", showlegend: false };
    const line = { color: mean, width: 4, showscale: label !== "", colorbar, ...scale };
    const marker = { size: 5, color: pale, line: { color: grey, width: 2 } };
    const traces = [
      { ...trace, mode: "lines", ...path, line },
      { ...trace, mode: "lines+markers", line: { width: 14, color: grey, ...scale }, marker },
    ];
    if (frames.solids) {
      const { faces, bodies } = frames.solids, [x, y, z] = placed(frames.solids, 0);
      const [i, j, k] = [0, 1, 2].map((corner) => faces.map((face) => face[corner]));
      const facecolor = i.map((vertex) => (bodies[vertex] < 0 ? grey : sky));
      traces.push({ ...trace, type: "mesh3d", x, y, z, i, j, k, facecolor, opacity: 0.25, lighting: { ambient: 0.9 } });
    }
    return traces;
  }

  // The camera looks from `eye`, as near as all corners of the axes and their labels allow.
  function cameraOf(ranges, aspect) {
    const sizes = ranges.map(([low, high]) => high - low), mean = Math.cbrt(sizes[0] * sizes[1] * sizes[2]);
    const half = sizes.map((size) => size / mean / 2), direction = [0.58, -0.73, 0.36];
    const flat = Math.hypot(direction[0], direction[1]), [a, b, c] = direction;
    const side = [-b / flat, a / flat, 0], upward = [(-c * a) / flat, (-c * b) / flat, flat];
    const dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
    const opening = Math.tan(Math.PI / 8); // of plotly's camera, half its height
    const distances = [0, 1, 2, 3, 4, 5, 6, 7].map((number) => {
      const corner = half.map((length, k) => (number & (1 << k) ? length : -length));
      const tangent = Math.max(Math.abs(dot(corner, upward)) / labelRoom[1], Math.abs(dot(corner, side)) / aspect / labelRoom[0]);
      return dot(corner, direction) + tangent / opening;
    });
    const [x, y, z] = direction.map((part) => part * Math.max(...distances));
    // The nearest corner is low: the middle of the picture is below that of the axes.
    return { eye: { x, y, z: z - 0.12 }, center: { x: 0, y: 0, z: -0.12 } };
  }

  function sceneOf(chart) {
    const plane = { gridcolor: grey, zerolinecolor: grey, backgroundcolor: "rgba(0,0,0,0)" };
    const { ranges } = chart.content, bottom = 0.14;
    const camera = cameraOf(ranges, widthOf(chart) / (parseFloat(chart.style.height) * (1 - bottom)));
    const scene = { aspectmode: "data", camera, domain: { x: [0, 1], y: [bottom, 1] }, dragmode: "turntable" };
    ["x", "y", "z"].forEach((name, k) => {
      scene[`${name}axis`] = { ...plane, title: { text: `${name} [m]` }, range: ranges[k], nticks: 5 };
    });
    return scene;
  }

  function layoutOf(chart) {
    const inSpace = Boolean(chart.content.frames);
    const layout = inSpace ? { scene: sceneOf(chart) } : panelsOf(chart.content);
    const margin = inSpace ? { l: 0, r: 0, t: 0, b: 0 } : { l: 52, r: 8, t: coarse ? 28 : 8, b: 40 };
    return {
      ...layout, margin, showlegend: false, dragmode: inSpace ? undefined : coarse ? false : "zoom",
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", modebar: { bgcolor: "rgba(0,0,0,0)" }, bargap: 0.2, barmode: "overlay",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: getComputedStyle(chart).color },
      width: widthOf(chart), height: parseFloat(chart.style.height),
    };
  }

  const widthOf = (chart) => Math.max(chart.clientWidth, 200);
  const same = (chart) => [...chart.closest("figure").querySelectorAll(".chart")];
  const drawn = (chart) => chart.classList.contains("drawn");

  function draw(chart) {
    if (drawn(chart)) return;
    chart.classList.add("drawn");
    // The page scrolls where plotly would take the wheel.
    chart.addEventListener("wheel", (event) => event.stopPropagation(), { capture: true });
    const { content } = chart, { frames } = content;
    const data = frames ? bodiesOf(content) : content.curves.map((curve) => traceOf(curve, content));
    Plotly.newPlot(chart, data, layoutOf(chart), optionsOf(chart));
    for (const button of chart.closest("figure").querySelectorAll("[data-curve][aria-pressed=false]"))
      show(chart, button.dataset.curve, false);
    if (frames) animate(chart, frames); else chart.on("plotly_relayout", (change) => follow(chart, change));
    sizes.observe(chart);
  }

  function resize(chart) {
    const width = widthOf(chart);
    if (drawn(chart) && chart.clientWidth && Math.abs(width - chart.layout.width) > 1) Plotly.relayout(chart, { width });
  }
  const sizes = new ResizeObserver((seen) => seen.forEach((entry) => resize(entry.target)));

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
    bar.innerHTML = '<button type="button">play</button><input type="range" min="0" aria-label="time along the motion"><output></output>';
    const [button, slider, clock] = bar.children;
    slider.max = String(frames.time.length - 1);
    slider.value = "0";
    chart.after(bar);
    let timer = 0;
    function pose(k) {
      const { x, y, z } = frames.points[k];
      const change = { x: [x], y: [y], z: [z] };
      if (frames.colours) change["line.color"] = [frames.colours[k]];
      clock.textContent = `${frames.time[k].toFixed(1)} s`;
      slider.setAttribute("aria-valuetext", `${frames.time[k].toFixed(1)} seconds of ${frames.time.at(-1).toFixed(1)}`);
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

  // Pictures without interaction: on the screen as wide as there is room, on paper by columns.
  function sketchAll(isPaper) {
    for (const chart of charts) {
      const columns = Number(chart.closest(".panels").style.getPropertyValue("--columns")), height = parseFloat(chart.style.height);
      // Names need all of the height.
      const paperShare = chart.content.panels?.[0].y_names.length ? 1 : 0.55;
      const [width, share] = isPaper ? [columns > 1 ? 224 : 690, paperShare] : [chart.clientWidth || 600, 1];
      chart.querySelector(":scope > .sketch")?.remove();
      chart.insertAdjacentHTML("afterbegin", sketches.draw(chart.content, width, Math.round(height * share)));
    }
  }

  function toPaper() {
    for (const part of document.querySelectorAll("details:not([open])")) { part.open = true; part.dataset.closed = ""; }
    sketchAll(true);
  }
  function toScreen() {
    for (const part of document.querySelectorAll("details[data-closed]")) { part.open = false; delete part.dataset.closed; }
    sketchAll(false);
  }

  // Ends of the axes in space, which hold all poses and shapes.
  function rangesOf({ path, frames }) {
    const clouds = [path, ...frames.points].map(({ x, y, z }) => [x, y, z]);
    if (frames.solids) for (let k = 0; k < frames.time.length; k += 5) clouds.push(placed(frames.solids, k));
    const ends = [0, 1, 2].map((axis) => sketches.extent(clouds.flatMap((cloud) => sketches.extent(cloud[axis]))));
    // The axes of all joints of a robot may meet in one point.
    const margin = Math.max(0.05, 0.06 * Math.max(...ends.map(([low, high]) => high - low)));
    return ends.map(([low, high]) => [low - margin, high + margin]);
  }

  // What a chart shows, for readers who hear the page.
  function describe(chart) {
    if (chart.content.frames) return `${chart.ariaLabel}: the robot in space; drag to turn it`;
    const [{ title, value, y_label, x }] = chart.content.panels;
    return [title, value, `${y_label} against ${x || "names"}`].filter(Boolean).join(", ");
  }

  for (const chart of charts) {
    chart.content = JSON.parse(chart.querySelector("script").textContent, numbers);
    // Abscissas of an earlier curve are named by its number.
    for (const curve of chart.content.curves ?? []) if (Number.isInteger(curve.x)) curve.x = chart.content.curves[curve.x].x;
    if (chart.content.frames) chart.content.ranges = rangesOf(chart.content);
    chart.ariaLabel = describe(chart);
  }
  sketchAll(false);
  document.body.dataset.sketched = "";
  addEventListener("beforeprint", toPaper);
  addEventListener("afterprint", toScreen);

  try {
    const code = document.createElement("script");
    code.textContent = await unpack(document.getElementById("library").textContent);
    document.head.append(code);
  } catch (error) {
    charts.forEach((chart) => { chart.title = "To zoom into this figure, use a browser of 2023 or later."; });
    throw error;
  }
  const near = new IntersectionObserver((seen) => seen.forEach((entry) => entry.isIntersecting && draw(entry.target)), { rootMargin: "600px" });
  charts.forEach((chart) => near.observe(chart));
  // The letters of the axes in space are no part of the page, and do not follow its colours.
  const recolour = () => charts.filter(drawn).forEach((chart) => Plotly.relayout(chart, { "font.color": getComputedStyle(chart).color }));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  document.querySelector(".theme").addEventListener("change", recolour);
  document.documentElement.dataset.ready = "";
})();
