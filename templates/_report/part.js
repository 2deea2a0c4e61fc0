"use strict";
// The path of the tool in three dimensions: grey as programmed, coloured with its deviation, enlarged.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("part"), draw = canvas.getContext("2d");
  const slider = document.getElementById("scale"), says = document.getElementById("says");
  const count = data.at.length;
  if (!count) return;
  const low = [0, 1, 2].map((k) => Math.min(...data.at.map((p) => p[k])));
  const high = [0, 1, 2].map((k) => Math.max(...data.at.map((p) => p[k])));
  const middle = low.map((v, k) => (v + high[k]) / 2);
  const size = Math.max(Math.hypot(...high.map((v, k) => v - low[k])), 1e-6);
  const sizes = data.off.map((d) => Math.hypot(...d));
  const most = Math.max(...sizes, 1e-9);
  let turn = -0.6, tilt = 0.9, zoom = 1, held = null;
  const seen = (p) => {
    const x = p[0] - middle[0], y = p[1] - middle[1], z = p[2] - middle[2];
    const u = x * Math.cos(turn) - y * Math.sin(turn), v = x * Math.sin(turn) + y * Math.cos(turn);
    const scale = (zoom * 0.85 * Math.min(canvas.width, canvas.height)) / size;
    return [canvas.width / 2 + scale * u, canvas.height / 2 - scale * (v * Math.cos(tilt) + z * Math.sin(tilt))];
  };
  const paint = () => {
    // the largest deviation is drawn up to a fifth of the part
    const factor = ((0.2 * size) / (most * 1e-3)) * (slider.value / 100);
    draw.clearRect(0, 0, canvas.width, canvas.height);
    draw.fillStyle = "#9a9a9a";
    for (const p of data.at) { const [x, y] = seen(p); draw.fillRect(x, y, 1.2, 1.2); }
    for (let k = 0; k < count; k++) {
      const p = data.at[k], d = data.off[k];
      const [x, y] = seen(p.map((v, i) => v + factor * d[i] * 1e-3));
      draw.fillStyle = `hsl(${220 * (1 - sizes[k] / most)}, 85%, 45%)`;
      draw.fillRect(x - 1, y - 1, 2.4, 2.4);
    }
    says.textContent = `${factor.toFixed(0)} times; blue 0, red ${most.toFixed(2)} um`;
  };
  canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    turn += (event.clientX - held[0]) * 0.01;
    tilt = Math.min(Math.PI / 2, Math.max(0, tilt - (event.clientY - held[1]) * 0.01));
    held = [event.clientX, event.clientY];
    paint();
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom *= Math.exp(-event.deltaY * 0.001); paint(); }, { passive: false });
  slider.addEventListener("input", paint);
  paint();
})();
