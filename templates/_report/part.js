"use strict";
// The path of the tool in three dimensions: grey as programmed, coloured by its deviation, with arrows to where the tool goes.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("part"), draw = canvas.getContext("2d");
  const slider = document.getElementById("scale"), says = document.getElementById("says");
  const count = data.at.length;
  if (!count) return;
  const low = [0, 1, 2].map((k) => data.at.reduce((least, p) => Math.min(least, p[k]), Infinity));
  const high = [0, 1, 2].map((k) => data.at.reduce((most, p) => Math.max(most, p[k]), -Infinity));
  const middle = low.map((v, k) => (v + high[k]) / 2);
  const size = Math.max(Math.hypot(...high.map((v, k) => v - low[k])), 1e-6);
  const sizes = data.off.map((d) => Math.hypot(...d));
  const most = sizes.reduce((a, b) => Math.max(a, b), 1e-9);
  const ARROWS = 150, LEAST_ARROW = 6, RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [230, 200, 30]];
  const step = Math.max(1, Math.round(count / ARROWS));
  let turn = -0.6, tilt = 0.9, zoom = 1, held = null;
  const colour = (share) => {
    const at = Math.min(share, 1) * (RAMP.length - 1), k = Math.min(Math.floor(at), RAMP.length - 2);
    return `rgb(${RAMP[k].map((v, i) => Math.round(v + (at - k) * (RAMP[k + 1][i] - v))).join(",")})`;
  };
  // a direction of the machine in the picture, and the place of a point
  const across = (x, y, z) => {
    const u = x * Math.cos(turn) - y * Math.sin(turn), v = x * Math.sin(turn) + y * Math.cos(turn);
    return [u, -(v * Math.cos(tilt) + z * Math.sin(tilt))];
  };
  const seen = (p) => {
    const scale = (zoom * 0.85 * Math.min(canvas.width, canvas.height)) / size;
    const [u, v] = across(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]);
    return [canvas.width / 2 + scale * u, canvas.height / 2 + scale * v];
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
    // the largest deviation is drawn up to a fifth of the part
    const factor = ((0.2 * size) / (most * 1e-3)) * (slider.value / 100), ink = getComputedStyle(canvas).color;
    draw.clearRect(0, 0, canvas.width, canvas.height);
    draw.lineWidth = 1.3;
    draw.font = "15px sans-serif";
    for (let k = 0; k < count; k++) {
      const p = data.at[k], d = data.off[k], [x, y] = seen(p);
      const [u, v] = seen(p.map((value, i) => value + factor * d[i] * 1e-3));
      draw.fillStyle = "#9a9a9a";
      draw.fillRect(x - 0.7, y - 0.7, 1.4, 1.4);
      draw.fillStyle = draw.strokeStyle = colour(sizes[k] / most);
      draw.fillRect(u - 1.4, v - 1.4, 2.8, 2.8);
      if (k % step === 0 && Math.hypot(u - x, v - y) > LEAST_ARROW) arrow(x, y, u, v, 7);
    }
    draw.fillStyle = draw.strokeStyle = ink;
    ["X", "Y", "Z"].forEach((name, k) => {
      const [u, v] = across(...[0, 1, 2].map((i) => (i === k ? 44 : 0))), x = 60, y = canvas.height - 60;
      if (Math.hypot(u, v) > LEAST_ARROW) arrow(x, y, x + u, y + v, 8);
      draw.fillText(name, x + 1.25 * u - 5, y + 1.25 * v + 5);
    });
    const left = canvas.width - 40, top = 40, tall = 200;
    for (let k = 0; k < tall; k++) { draw.fillStyle = colour(k / tall); draw.fillRect(left, top + tall - k, 16, 1.5); }
    draw.fillStyle = ink;
    draw.textAlign = "right";
    for (const share of [0, 0.5, 1]) draw.fillText((share * most).toPrecision(3) + " µm", left - 6, top + tall * (1 - share) + 5);
    draw.textAlign = "left";
    says.textContent = `${factor.toPrecision(2) >= 1 ? Number(factor.toPrecision(2)) : factor.toPrecision(2)} times`;
  };
  const turned = (right, down) => {
    turn += right * 0.01;
    tilt = Math.min(Math.PI / 2, Math.max(0, tilt - down * 0.01));
    paint();
  };
  canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const before = held;
    held = [event.clientX, event.clientY];
    turned(held[0] - before[0], held[1] - before[1]);
  });
  canvas.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, -10], ArrowDown: [0, 10] }[event.key];
    if (by) { event.preventDefault(); turned(...by); }
    if (event.key === "+" || event.key === "-") { zoom *= event.key === "+" ? 1.2 : 1 / 1.2; paint(); }
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom *= Math.exp(-event.deltaY * 0.001); paint(); }, { passive: false });
  slider.addEventListener("input", paint);
  paint();
})();
