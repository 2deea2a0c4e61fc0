"use strict";
// Draws what artefacts and circles show again when a slider of an error is moved: the sum of the responses of all errors,
// each times its share. The first drawing is that of compgen/planning/gauges.py.
(function () {
  var root = document.documentElement;
  var DEVIATION = root.dataset.deviation || "\u00b5m", PER_UM = Number(root.dataset.perUm || 1);
  root.classList.add("script");
  var data = JSON.parse(document.getElementById("data").textContent);
  var sliders = Array.prototype.slice.call(document.querySelectorAll("input[data-error]"));

  function shares() {
    var found = {};
    sliders.forEach(function (slider) { found[slider.dataset.error] = Number(slider.value) / 100; });
    return found;
  }
  function point(x, y) { return x.toFixed(2) + " " + y.toFixed(2); }

  // A round number of the unit that is shown, in um, at or above a length, as ticks of charts.py with one division.
  function rounded(um) {
    return roundedUp(um * PER_UM) / PER_UM;
  }
  function roundedUp(um) {
    um = Math.max(um, 0.1);
    var power = Math.pow(10, Math.floor(Math.log10(um)));
    var step = power * [1, 2, 5, 10].find(function (factor) { return factor * power >= 0.999 * um; });
    return Math.ceil(um / step - 1e-9) * step;
  }
  function text(um) { return String(Number((um * PER_UM).toPrecision(3))); }

  // sums of all responses: numbers for a circle, pairs for an artefact
  function sums(item, share) {
    return (item.circle || item.arrows).map(function (_, k) {
      var x = 0, y = 0;
      Object.keys(item.responses).forEach(function (name) {
        var value = item.responses[name][k];
        x += share[name] * (item.circle ? value : value[0]);
        y += share[name] * (item.circle ? 0 : value[1]);
      });
      return [x, y];
    });
  }
  function circlePath(item, found, scale) {
    var places = item.circle.map(function (degrees, k) {
      var angle = degrees * Math.PI / 180, radius = item.radius + found[k][0] * scale;
      return point(item.middle[0] + radius * Math.cos(angle), item.middle[1] - radius * Math.sin(angle));
    });
    return "M" + places.concat(item.closed ? places[0] : []).join(" ");
  }
  function arrowPath(item, found, scale, k) {
    var dx = found[k][0] * scale, dy = -found[k][1] * scale, x = item.arrows[k][0], y = item.arrows[k][1];
    var tip = point(x + dx, y + dy);
    return "M" + [point(x, y), tip, point(x + 0.75 * dx + 0.12 * dy, y + 0.75 * dy - 0.12 * dx), tip,
      point(x + 0.75 * dx - 0.12 * dy, y + 0.75 * dy + 0.12 * dx), tip].join(" ");
  }
  function draw() {
    var share = shares();
    sliders.forEach(function (slider) { slider.parentNode.querySelector("output").textContent = slider.value + " %"; });
    Object.keys(data).forEach(function (key) {
      var item = data[key], figure = document.getElementById("figure-" + key), found = sums(item, share);
      var step = rounded(Math.max.apply(null, found.map(function (um) { return Math.hypot(um[0], um[1]); })));
      var labels = figure.querySelectorAll(".layer-scale text"), paths = figure.querySelectorAll(".layer-shown path");
      labels[0].textContent = (item.circle ? "\u2212" : "") + text(step) + " " + DEVIATION;
      if (item.circle) { labels[1].textContent = "+" + text(step) + " " + DEVIATION; }
      Array.prototype.forEach.call(paths, function (path, k) {
        var scale = item.step / step;
        path.setAttribute("d", item.circle ? circlePath(item, found, scale) : arrowPath(item, found, scale, k));
      });
    });
  }
  function set(value) { sliders.forEach(function (slider) { slider.value = value(slider); }); draw(); }

  sliders.forEach(function (slider) { slider.addEventListener("input", draw); });
  Array.prototype.forEach.call(document.querySelectorAll("button[data-only]"), function (button) {
    button.addEventListener("click", function () {
      set(function (slider) { return slider.dataset.error === button.dataset.only ? 100 : 0; });
    });
  });
  Array.prototype.forEach.call(document.querySelectorAll("button[data-all]"), function (button) {
    button.addEventListener("click", function () { set(function () { return button.dataset.all; }); });
  });
  root.dataset.ready = "1";
})();
