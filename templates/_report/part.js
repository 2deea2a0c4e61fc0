"use strict";
// The path of the tool in three dimensions: grey as programmed, coloured by its deviation, with arrows to where the tool goes.
(() => {
  document.documentElement.classList.add("script");
  // units of what is shown; a page in inch states others
  const { length: LENGTH = "mm", deviation: DEVIATION = "µm", perMm = 1, perUm = 1 } = document.documentElement.dataset;
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("part"), draw = canvas.getContext("2d");
  const slider = document.getElementById("scale"), says = document.getElementById("says"), view = document.getElementById("view");
  const count = data.at.length;
  if (!count) { canvas.hidden = true; return; }
  const low = [0, 1, 2].map((k) => data.at.reduce((least, p) => Math.min(least, p[k]), Infinity));
  const high = [0, 1, 2].map((k) => data.at.reduce((most, p) => Math.max(most, p[k]), -Infinity));
  const middle = low.map((v, k) => (v + high[k]) / 2);
  const size = Math.max(Math.hypot(...high.map((v, k) => v - low[k])), 1e-6);
  const sizes = data.off.map((off) => off.map((d) => Math.hypot(...d)));
  const ARROWS = 150, LEAST_ARROW = 6, RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [230, 200, 30]];
  const DARK_RAMP = [[122, 84, 190], [84, 130, 214], [52, 178, 170], [124, 222, 120], [250, 226, 80]];
  const step = Math.max(1, Math.round(count / ARROWS));
  let turn = -0.6, tilt = 0.9, zoom = 1, shift = [0, 0], held = null, waiting = false;
  const dark = () => getComputedStyle(canvas).colorScheme.includes("dark") || getComputedStyle(document.documentElement).colorScheme === "dark";
  const round = (value) => {
    const power = 10 ** Math.floor(Math.log10(value));
    return [5, 2, 1].map((part) => part * power).find((part) => part <= value * 1.0001);
  };
  // a direction of the machine in the picture
  const across = (x, y, z) => {
    const u = x * Math.cos(turn) - y * Math.sin(turn), v = x * Math.sin(turn) + y * Math.cos(turn);
    return [u, -(v * Math.cos(tilt) + z * Math.sin(tilt))];
  };
  const arrow = (x, y, u, v, head) => {
    const length = Math.hypot(u - x, v - y), a = (u - x) / length, b = (v - y) / length;
    draw.beginPath();
    draw.moveTo(x, y);
    draw.lineTo(u, v);
    draw.moveTo(u - head * (a + 0.5 * b), v - head * (b - 0.5 * a));
    draw.lineTo(u, v);
    draw.lineTo(u - head * (a - 0.5 * b), v - head * (b + 0.5 * a));
    draw.stroke();
  };
  const paint = () => {
    waiting = false;
    const wide = canvas.clientWidth, tall = canvas.clientHeight, dots = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(wide * dots)) canvas.width = Math.round(wide * dots);
    if (canvas.height !== Math.round(tall * dots)) canvas.height = Math.round(tall * dots);
    draw.setTransform(dots, 0, 0, dots, 0, 0);
    const style = getComputedStyle(canvas), ink = style.color, muted = style.getPropertyValue("--muted") || "#888";
    const ramp = dark() ? DARK_RAMP : RAMP;
    const colour = (share) => {
      const at = Math.min(share, 1) * (ramp.length - 1), k = Math.min(Math.floor(at), ramp.length - 2);
      return `rgb(${ramp[k].map((v, i) => Math.round(v + (at - k) * (ramp[k + 1][i] - v))).join(",")})`;
    };
    const which = view ? Number(view.value) : 0, off = data.off[which];
    const most = sizes[which].reduce((a, b) => Math.max(a, b), 1e-9);
    const scale = (zoom * 0.85 * Math.min(wide, tall)) / size;
    // the largest deviation is drawn up to a fifth of the part
    const factor = ((0.2 * size) / (most * 1e-3)) * (slider.value / 100) ** 2 * 4;
    const seen = (p) => {
      const [u, v] = across(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]);
      return [wide / 2 + shift[0] + scale * u, tall / 2 + shift[1] + scale * v];
    };
    draw.clearRect(0, 0, wide, tall);
    draw.lineWidth = 1.3;
    draw.font = "14px system-ui, sans-serif";
    draw.textBaseline = "middle";
    draw.fillStyle = muted;
    const places = data.at.map(seen);
    for (const [x, y] of places) draw.fillRect(x - 0.7, y - 0.7, 1.4, 1.4);
    for (let k = 0; k < count; k++) {
      const p = data.at[k], d = off[k], [x, y] = places[k];
      const [u, v] = seen([p[0] + factor * d[0] * 1e-3, p[1] + factor * d[1] * 1e-3, p[2] + factor * d[2] * 1e-3]);
      draw.fillStyle = draw.strokeStyle = colour(sizes[which][k] / most);
      draw.fillRect(u - 1.4, v - 1.4, 2.8, 2.8);
      if (k % step === 0 && Math.hypot(u - x, v - y) > LEAST_ARROW) arrow(x, y, u, v, 7);
    }
    draw.fillStyle = draw.strokeStyle = ink;
    ["X", "Y", "Z"].forEach((name, k) => {
      const [u, v] = across(...[0, 1, 2].map((i) => (i === k ? 44 : 0))), x = 62, y = tall - 70;
      if (Math.hypot(u, v) > LEAST_ARROW) arrow(x, y, x + u, y + v, 8);
      draw.fillText(name, x + 1.25 * u - 5, y + 1.25 * v);
    });
    // colours in um; what an arrow and a part of this length are
    const left = wide - 30, top = 24, bar = Math.min(200, tall - 150);
    for (let k = 0; k < bar; k++) { draw.fillStyle = colour(k / bar); draw.fillRect(left, top + bar - k, 16, 1.5); }
    draw.fillStyle = draw.strokeStyle = ink;
    draw.textAlign = "right";
    for (const share of [0, 0.5, 1]) draw.fillText((share * most * perUm).toPrecision(3) + ` ${DEVIATION}`, left - 6, top + bar * (1 - share));
    const onePixel = 1 / (scale * factor * 1e-3), deviation = round(90 * onePixel * perUm) / perUm, length = round((110 / scale) * perMm) / perMm;
    if (factor > 0) {
      arrow(wide - 14 - deviation / onePixel, tall - 44, wide - 14, tall - 44, 7);
      draw.fillText(`${Number((deviation * perUm).toPrecision(2))} ${DEVIATION}`, wide - 22 - deviation / onePixel, tall - 44);
    }
    draw.fillRect(wide - 14 - length * scale, tall - 21, length * scale, 3);
    draw.fillText(`${Number((length * perMm).toPrecision(2))} ${LENGTH}`, wide - 22 - length * scale, tall - 20);
    draw.textAlign = "left";
    says.textContent = `${factor.toPrecision(2) >= 1 ? Number(factor.toPrecision(2)) : factor.toPrecision(2)} ${canvas.dataset.times}`;
  };
  const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(paint); } };
  const moved = (right, down, aside) => {
    if (aside) shift = [shift[0] + right, shift[1] + down];
    else {
      turn += right * 0.01;
      tilt = Math.min(Math.PI / 2, Math.max(0, tilt - down * 0.01));
    }
    later();
  };
  const zoomed = (by) => { zoom = Math.min(200, Math.max(0.2, zoom * by)); later(); };
  canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { held = null; });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const before = held;
    held = [event.clientX, event.clientY];
    moved(held[0] - before[0], held[1] - before[1], event.shiftKey);
  });
  canvas.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, -10], ArrowDown: [0, 10] }[event.key];
    if (by) { event.preventDefault(); moved(...by, event.shiftKey); }
    if (event.key === "+" || event.key === "-") zoomed(event.key === "+" ? 1.2 : 1 / 1.2);
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoomed(Math.exp(-event.deltaY * 0.001)); }, { passive: false });
  document.getElementById("home").addEventListener("click", () => { turn = 0; tilt = 0; zoom = 1; shift = [0, 0]; later(); });
  slider.addEventListener("input", later);
  if (view) view.addEventListener("change", later);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", later);
  new ResizeObserver(later).observe(canvas);
  paint();
})();
