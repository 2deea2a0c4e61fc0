"use strict";
(function () {
  var root = document.documentElement;
  var data = JSON.parse(document.getElementById("data").textContent);
  var tip = document.getElementById("tip");
  var SVG = "http://www.w3.org/2000/svg";
  root.classList.add("script");

  function all(selector, base) { return Array.prototype.slice.call((base || document).querySelectorAll(selector)); }

  // light and dark
  var theme = document.getElementById("theme");
  var wanted = window.matchMedia("(prefers-color-scheme: dark)");
  function isDark() { return root.dataset.theme ? root.dataset.theme === "dark" : wanted.matches; }
  function nameTheme() { theme.setAttribute("aria-pressed", String(isDark())); }
  theme.addEventListener("click", function () { root.dataset.theme = isDark() ? "light" : "dark"; nameTheme(); });
  wanted.addEventListener("change", nameTheme);
  nameTheme();

  // which control is shown
  var chooser = document.getElementById("control");
  function showControl(number) {
    root.dataset.control = number;
    all(".control").forEach(function (part) { part.style.display = part.classList.contains("control-" + number) ? "block" : "none"; });
    all(".layer").forEach(function (part) {
      var found = /layer-control-(\d+)/.exec(part.getAttribute("class"));
      if (found) { part.style.display = found[1] === number ? "inline" : "none"; }
    });
  }
  if (chooser) { chooser.addEventListener("change", function () { showControl(chooser.value); }); showControl(chooser.value); }

  // layers of the picture in space
  all("[data-views]").forEach(function (views) {
    all("button[data-layer]", views).forEach(function (button) {
      button.addEventListener("click", function () {
        var shown = views.classList.toggle("show-" + button.dataset.layer);
        button.setAttribute("aria-pressed", String(shown));
      });
    });
  });

  // one error enlarged
  var error = document.getElementById("error");
  function enlarge(key) {
    all(".picture.large").forEach(function (figure) { figure.classList.remove("large"); });
    var figure = key && document.getElementById("figure-" + key);
    if (figure) { figure.classList.add("large"); figure.scrollIntoView({ block: "nearest" }); }
    if (error) { error.value = key; }
  }
  if (error) { error.addEventListener("change", function () { enlarge(error.value); }); }
  all(".picture.curve").forEach(function (figure) {
    figure.addEventListener("dblclick", function () { enlarge(figure.classList.contains("large") ? "" : figure.dataset.key); });
  });

  // values under the pointer, or by the arrow keys
  function show(figure, at, text, x, y) {
    var svg = figure.querySelector("svg");
    var mark = svg.querySelector(".mark");
    if (!mark) {
      mark = document.createElementNS(SVG, "circle");
      mark.setAttribute("class", "mark");
      mark.setAttribute("r", "4");
      svg.appendChild(mark);
    }
    mark.setAttribute("cx", at[0]);
    mark.setAttribute("cy", at[1]);
    tip.textContent = text;
    tip.hidden = false;
    tip.style.left = Math.max(4, Math.min(x + 14, window.innerWidth - tip.offsetWidth - 8)) + "px";
    tip.style.top = Math.max(4, Math.min(y + 14, window.innerHeight - tip.offsetHeight - 8)) + "px";
  }
  function hide(figure) {
    var mark = figure.querySelector(".mark");
    if (mark) { mark.remove(); }
    tip.hidden = true;
  }
  function number(value) { return String(Number(value.toPrecision(4))).replace("-", "\u2212"); }
  function placeOf(item, x, y) {
    var f = item.frame, l = item.limits;
    return [f[0] + (x - l[0]) / (l[1] - l[0]) * (f[2] - f[0]), f[3] - (y - l[2]) / (l[3] - l[2]) * (f[3] - f[1])];
  }
  function isVisible(item, series) {
    return !chooser || series.name.indexOf("table ") !== 0 || series.name === "table " + chooser.options[chooser.selectedIndex].text;
  }
  function curveText(item, index) {
    var first = item.series[0], at = first.x[index], lines = [number(at) + " mm"];
    item.series.forEach(function (series) {
      var k = series.x.findIndex(function (x) { return Math.abs(x - at) < 1e-6; });
      if (k < 0 || series.y[k] === null || !isVisible(item, series)) { return; }
      var more = series.U && series.U[k] !== null ? " \u00b1 " + number(series.U[k]) : "";
      lines.push(series.name + ": " + number(series.y[k]) + more);
    });
    return lines.join("\n");
  }
  function nearest(values, wantedValue) {
    var best = 0;
    values.forEach(function (value, k) { if (Math.abs(value - wantedValue) < Math.abs(values[best] - wantedValue)) { best = k; } });
    return best;
  }
  function showCurve(figure, item, index, x, y) {
    var first = item.series[0];
    figure.dataset.index = index;
    show(figure, placeOf(item, first.x[index], first.y[index] || 0), curveText(item, index), x, y);
  }
  function hoverCurve(figure, item, px, py, event) {
    var f = item.frame, l = item.limits;
    if (px < f[0] - 6 || px > f[2] + 6) { hide(figure); return; }
    showCurve(figure, item, nearest(item.series[0].x, l[0] + (px - f[0]) / (f[2] - f[0]) * (l[1] - l[0])), event.clientX, event.clientY);
  }
  function hoverSlice(figure, item, px, py, event) {
    var slice = item.slices.find(function (s) { return px >= s.frame[0] && px < s.frame[2] && py >= s.frame[1] && py < s.frame[3]; });
    if (!slice) { hide(figure); return; }
    var f = slice.frame, n = slice.cells, e = slice.ends;
    var i = Math.floor((px - f[0]) / (f[2] - f[0]) * n), j = Math.floor((f[3] - py) / (f[3] - f[1]) * n);
    i = Math.max(0, Math.min(n - 1, i)); j = Math.max(0, Math.min(n - 1, j));
    var v = slice.values[j * n + i], size = Math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    var text = slice.axes[0] + " " + number(e[0] + i * (e[1] - e[0]) / (n - 1)) + ", " + slice.axes[1] + " " + number(e[2] + j * (e[3] - e[2]) / (n - 1)) + " mm\n" +
      number(size) + " \u00b5m: X " + number(v[0]) + ", Y " + number(v[1]) + ", Z " + number(v[2]);
    show(figure, [f[0] + (i + 0.5) / n * (f[2] - f[0]), f[3] - (j + 0.5) / n * (f[3] - f[1])], text, event.clientX, event.clientY);
  }
  all(".picture[data-key]").forEach(function (figure) {
    var item = data[figure.dataset.key], svg = figure.querySelector("svg");
    if (!item || !(item.series || item.slices)) { return; }
    svg.addEventListener("mousemove", function (event) {
      var box = svg.getBoundingClientRect(), view = svg.viewBox.baseVal;
      var scale = Math.min(box.width / view.width, box.height / view.height);
      var px = (event.clientX - box.left - (box.width - scale * view.width) / 2) / scale;
      var py = (event.clientY - box.top - (box.height - scale * view.height) / 2) / scale;
      (item.series ? hoverCurve : hoverSlice)(figure, item, px, py, event);
    });
    svg.addEventListener("mouseleave", function () { hide(figure); });
    if (!item.series) { return; }
    figure.addEventListener("blur", function () { hide(figure); });
    figure.addEventListener("keydown", function (event) {
      var step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === "Enter" && figure.classList.contains("curve")) { enlarge(figure.classList.contains("large") ? "" : figure.dataset.key); return; }
      if (event.key === "Escape") { hide(figure); return; }
      if (!step) { return; }
      event.preventDefault();
      var index = Math.max(0, Math.min(item.series[0].x.length - 1, Number(figure.dataset.index || 0) + step));
      var box = figure.getBoundingClientRect();
      showCurve(figure, item, index, box.left + 20, box.top + 20);
    });
  });

  // everything is printed
  window.addEventListener("beforeprint", function () { all("details").forEach(function (part) { part.open = true; }); });
  root.dataset.ready = "1";
})();
