"use strict";
// First pictures of the figures, for paper too: SVG without interaction, drawn at once.
const sketches = (() => {
  const fontSize = 11, tickRoom = 57, labelRoom = 34, margin = 8, gap = 10;
  const colours = ["#3d9bd6", "#c27d00", "#d55e00"]; // from small to large, as `scale` in figures.js
  const eye = [1.2, -1.5, 0.7];

  const escaped = (text) => String(text).replace(/[&<>"']/g, (letter) => `&#${letter.charCodeAt(0)};`);
  const rounded = (value) => Math.round(10 * value) / 10;
  const text = (content, x, y, anchor = "middle", more = "") =>
    `<text x="${rounded(x)}" y="${rounded(y)}" text-anchor="${anchor}" ${more}>${escaped(content)}</text>`;
  const line = (x1, y1, x2, y2, style) =>
    `<line x1="${rounded(x1)}" y1="${rounded(y1)}" x2="${rounded(x2)}" y2="${rounded(y2)}" ${style}/>`;
  const extent = (values) => values.reduce(([low, high], v) => (Number.isFinite(v) ? [Math.min(low, v), Math.max(high, v)] : [low, high]), [Infinity, -Infinity]);

  // Round values between two ends, about as many as `count`.
  function ticksBetween(low, high, count) {
    const power = 10 ** Math.floor(Math.log10((high - low) / count));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= (high - low) / count);
    const first = Math.ceil(low / step), last = Math.floor(high / step + 1e-9);
    return Array.from({ length: last - first + 1 }, (_, k) => (first + k) * step);
  }

  // An axis between two pixels: where a value is drawn, and the ticks.
  function axisBetween([low, high], start, end, { logarithmic = false, names = [], count = 4 } = {}) {
    const inward = logarithmic ? Math.log10 : (value) => value;
    let [first, last] = [inward(low), inward(high)];
    if (!(last > first)) [first, last] = [(first || 0) - 1, (first || 0) + 1];
    const place = (value) => start + ((inward(value) - first) / (last - first)) * (end - start);
    if (names.length) return { place, ticks: names.map((name, k) => [k, name]) };
    if (!logarithmic) return { place, ticks: ticksBetween(first, last, count).map((v) => [v, String(Number(v.toPrecision(6)))]) };
    const decades = ticksBetween(first, last, count).filter(Number.isInteger);
    return { place, ticks: decades.map((decade) => [10 ** decade, String(Number((10 ** decade).toPrecision(1)))]) };
  }

  // Ends of the values that curves have, with some room around them.
  function rangeOf(curves, keys, logarithmic) {
    const ends = curves.flatMap((curve) => keys.filter((key) => curve[key]).map((key) => extent(Array.from(curve[key]).filter((v) => !logarithmic || v > 0))));
    const [low, high] = extent(ends.flat());
    return logarithmic ? [low / 1.3, high * 1.3] : [low - 0.05 * (high - low), high + 0.05 * (high - low)];
  }

  // Points of a line; it starts again behind a gap.
  function pathOf(x, y, toX, toY) {
    let path = "", command = "M";
    for (let k = 0; k < x.length; k++) {
      const [u, v] = [toX(x[k]), toY(y[k])];
      if (Number.isFinite(u) && Number.isFinite(v)) { path += `${command}${rounded(u)} ${rounded(v)}`; command = "L"; } else command = "M";
    }
    return path;
  }

  const dots = ({ x, y, colour }, toX, toY, radius) =>
    Array.from(x, (value, k) => `<circle cx="${rounded(toX(value))}" cy="${rounded(toY(y[k]))}" r="${radius}" fill="${colour}"/>`).join("");

  const shapes = {
    line(curve, toX, toY) {
      const dashes = curve.dashed ? 'stroke-dasharray="5 3"' : "";
      const path = `<path d="${pathOf(curve.x, curve.y, toX, toY)}" fill="none" stroke="${curve.colour}" stroke-width="${0.4 + curve.width}" ${dashes}/>`;
      return path + (curve.marker ? dots(curve, toX, toY, 2) : "");
    },
    points: (curve, toX, toY) => dots(curve, toX, toY, 2.5),
    band({ x, low, high, colour }, toX, toY) {
      const across = [...x, ...[...x].reverse()], along = [...high, ...[...low].reverse()];
      return `<path d="${pathOf(across, along, toX, toY)}Z" fill="${colour}" fill-opacity="0.35"/>`;
    },
    bars({ x, y, width, colour }, toX, toY) {
      return Array.from(x, (middle, k) => {
        const left = toX(middle - width / 2), top = Math.min(toY(y[k]), toY(0));
        return `<rect x="${rounded(left)}" y="${rounded(top)}" width="${rounded(toX(middle + width / 2) - left)}" height="${rounded(Math.abs(toY(y[k]) - toY(0)) || 0)}" fill="${colour}"/>`;
      }).join("");
    },
    intervals(curve, toX, toY) {
      const { y, low, high, colour } = curve;
      const lines = Array.from(y, (value, k) => line(toX(low[k]), toY(value), toX(high[k]), toY(value), `stroke="${colour}" stroke-width="1.6"`));
      return lines.join("") + dots(curve, toX, toY, 2.5);
    },
  };

  // Names below an axis are turned where they need more room than there is.
  function nameTick(name, x, y, room) {
    const turned = name.length * 0.56 * fontSize > room;
    return turned ? text(name, x, y, "end", `transform="rotate(-28 ${rounded(x)} ${rounded(y)})"`) : text(name, x, y);
  }

  // The axis that all panels of a stack share, and the room of its names.
  function sharedAxis([{ x_range, x_names, log }], curves, left, width) {
    const logarithmic = log.includes("x");
    const keys = curves.some((curve) => curve.kind === "intervals") ? ["x", "low", "high"] : ["x"];
    const ends = x_names.length ? [-0.6, x_names.length - 0.4] : rangeOf(curves, keys, logarithmic);
    const axis = axisBetween(x_range || ends, left, width - margin, { logarithmic, names: x_names, count: width / 90 });
    return { ...axis, names: x_names, nameWidth: (width - left - margin) / (x_names.length || 1) };
  }

  function ownAxis(panel, curves, top, bottom) {
    const names = panel.y_names, logarithmic = panel.log.includes("y");
    // Names stand from the top to the bottom.
    if (names.length) return axisBetween([-0.6, names.length - 0.4], top, bottom, { names });
    const keys = curves.some((curve) => curve.kind === "band") ? ["y", "low", "high"] : ["y"];
    const zero = curves.some((curve) => curve.kind === "bars") ? [{ y: [0] }] : [];
    // The axis holds its limits, too, as that of plotly does.
    const limits = { y: panel.levels.filter(([which]) => which === "y").map(([, value]) => value) };
    const range = rangeOf([...curves, ...zero, limits], keys, logarithmic);
    return axisBetween(range, bottom, top, { logarithmic, count: panel.share < 1 ? 2 : 4 });
  }

  function gridOf(across, up, [left, right, top, bottom]) {
    const rows = up.ticks.map(([value, label]) => {
      const y = up.place(value);
      return line(left, y, right, y, 'class="grid"') + text(label, left - 5, y + 0.35 * fontSize, "end");
    });
    const columns = across.names.length ? [] : across.ticks.map(([value]) => line(across.place(value), top, across.place(value), bottom, 'class="grid"'));
    return [...rows, ...columns].join("");
  }

  function levelOf([which, value, colour], across, up, [left, right, top, bottom]) {
    const style = `stroke="${colour}" ${value ? 'stroke-dasharray="4 3"' : ""}`;
    const place = which === "x" ? across.place(value) : up.place(value);
    return which === "x" ? line(place, top, place, bottom, style) : line(left, place, right, place, style);
  }

  // One panel in its box [left, right, top, bottom]; what leaves the box is cut.
  function panelOf(panel, curves, across, box) {
    const [left, right, top, bottom] = box, middle = (top + bottom) / 2;
    const up = ownAxis(panel, curves, top, bottom);
    const frame = [left, top, right - left, bottom - top].map(rounded);
    const cut = `<svg x="${frame[0]}" y="${frame[1]}" width="${frame[2]}" height="${frame[3]}" viewBox="${frame.join(" ")}">`;
    const drawn = curves.map((curve) => shapes[curve.kind](curve, across.place, up.place)).join("");
    const levels = panel.levels.map((level) => levelOf(level, across, up, box)).join("");
    const turn = `transform="rotate(-90 ${fontSize} ${rounded(middle)})"`;
    const label = panel.y_names.length ? "" : text(panel.y_label, fontSize, middle, "middle", turn);
    return `${gridOf(across, up, box)}${cut}${levels}${drawn}</svg>${line(left, top, left, bottom, 'class="axis"')}${label}`;
  }

  function panelsOf({ panels, curves }, width, height) {
    const widthOf = (name) => 0.56 * fontSize * name.length;
    const left = Math.max(tickRoom, ...panels.flatMap(({ y_names }) => y_names.map((name) => widthOf(name) + margin)));
    const across = sharedAxis(panels, curves, left, width), right = width - margin;
    const longest = Math.max(0, ...across.names.map(widthOf));
    const below = labelRoom + (longest > across.nameWidth ? 0.47 * longest : 0);
    const room = height - margin - below - gap * (panels.length - 1);
    const total = panels.reduce((sum, panel) => sum + panel.share, 0);
    let top = margin, content = "";
    panels.forEach((panel, number) => {
      const bottom = top + (room * panel.share) / total;
      const own = curves.filter((curve) => curve.panel === number);
      content += panelOf(panel, own, across, [left, right, top, bottom]);
      top = bottom + gap;
    });
    const bottom = top - gap, y = bottom + 14;
    const ticks = across.ticks.map(([value, label]) => {
      const x = across.place(value);
      return across.names.length ? nameTick(label, x, y, across.nameWidth) : text(label, x, y);
    });
    const axis = line(left, bottom, right, bottom, 'class="axis"') + ticks.join("");
    return content + axis + text(panels[0].x, (left + width) / 2, height - 4);
  }

  function colourOf(share) {
    const place = 2 * Math.min(Math.max(share, 0), 1), k = Math.min(Math.floor(place), 1);
    return `color-mix(in srgb, ${colours[k + 1]} ${Math.round(100 * (place - k))}%, ${colours[k]})`;
  }

  // Where a point in space is drawn, seen from `eye`, so that all corners are inside.
  function projection(corners, width, height) {
    const along = (axis, p) => axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2];
    const ahead = eye.map((part) => part / Math.hypot(...eye)), flat = Math.hypot(ahead[0], ahead[1]);
    const side = [-ahead[1] / flat, ahead[0] / flat, 0];
    const upward = [-ahead[2] * side[1], ahead[2] * side[0], ahead[0] * side[1] - ahead[1] * side[0]];
    const [left, right] = extent(corners.map((corner) => along(side, corner)));
    const [low, high] = extent(corners.map((corner) => along(upward, corner)));
    const zoom = Math.min((width - 2 * margin) / (right - left), (height - 2 * labelRoom) / (high - low));
    return (p) => [
      width / 2 + zoom * (along(side, p) - (left + right) / 2),
      (height - labelRoom) / 2 - zoom * (along(upward, p) - (low + high) / 2),
    ];
  }

  const stroke = (from, to, style) => line(from[0], from[1], to[0], to[1], style);

  function edgesOf(corners, ranges, place, width) {
    return ["x", "y", "z"].map((name, axis) => {
      const [u, v] = place(corners[1 << axis]), length = (ranges[axis][1] - ranges[axis][0]).toFixed(2);
      const label = text(`${name}: ${length} m`, Math.min(Math.max(u, 40), width - 40), axis === 2 ? v - 6 : v + 14);
      return stroke(place(corners[0]), [u, v], 'class="axis"') + label;
    }).join("");
  }

  // The path of the end-effector in pieces of one colour.
  function trackOf(points, mean, largest) {
    const stride = Math.max(1, Math.floor(points.length / 200));
    let content = "";
    for (let k = 0; k + stride < points.length; k += stride) {
      const piece = points.slice(k, k + stride + 1).map(([u, v], n) => `${n ? "L" : "M"}${rounded(u)} ${rounded(v)}`);
      const colour = largest === null ? colours[0] : colourOf(mean[k] / largest);
      content += `<path d="${piece.join("")}" fill="none" stroke-width="2" stroke="${colour}"/>`;
    }
    return content;
  }

  // The robot's links; behind the two ends of each there is a gap.
  function bonesOf(points, values, largest) {
    let content = "";
    for (let k = 0; k + 1 < points.length; k += 3) {
      const colour = values ? colourOf(values[k] / largest) : "var(--grey)";
      content += stroke(points[k], points[k + 1], `stroke="${colour}" stroke-width="7" stroke-linecap="round"`);
    }
    return content;
  }

  function scaleOf(largest, label, width, height) {
    const start = width / 2 - 100, y = height - fontSize - 12;
    const parts = Array.from({ length: 20 }, (_, k) => `<rect x="${start + 10 * k}" y="${y}" width="10.5" height="8" fill="${colourOf((k + 0.5) / 20)}"/>`);
    const ends = text("0", start - 8, y + 8, "end") + text(largest.toPrecision(2), start + 208, y + 8, "start");
    return parts.join("") + ends + text(label, width / 2, height - 3);
  }

  // The path of the end-effector, and the robot in the middle of the motion.
  function sceneOf({ path, mean, largest, label, frames, ranges }, width, height) {
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((number) => ranges.map((range, axis) => range[(number >> axis) & 1]));
    const place = projection(corners, width, height);
    const pointsOf = ({ x, y, z }) => Array.from(x, (_, k) => place([x[k], y[k], z[k]]));
    const frame = Math.floor(frames.points.length / 2);
    return [
      edgesOf(corners, ranges, place, width),
      trackOf(pointsOf(path), mean, largest),
      bonesOf(pointsOf(frames.points[frame]), frames.colours?.[frame], largest),
      largest === null ? "" : scaleOf(largest, label, width, height),
    ].join("");
  }

  function draw(content, width, height) {
    const inside = content.frames ? sceneOf(content, width, height) : panelsOf(content, width, height);
    return `<svg class="sketch" aria-hidden="true" viewBox="0 0 ${width} ${height}" width="${width}" height="${height}" font-size="${fontSize}">${inside}</svg>`;
  }

  return { draw, extent };
})();
