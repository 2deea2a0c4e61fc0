"use strict";
// Zoom and values under the pointer for the pictures that compgen/drawing/charts.py draws: every figure.picture contains one
// svg.plot with one g.axes; "data" holds the values of its curves or cells by the figure's key.
(function () {
  var root = document.documentElement;
  var SVG = "http://www.w3.org/2000/svg";
  var source = document.getElementById("data");
  var data = source ? JSON.parse(source.textContent) : {};
  var tip = document.getElementById("tip");
  // units of what is shown; a page in inch states others
  var LENGTH = root.dataset.length || "mm", DEVIATION = root.dataset.deviation || "\u00b5m";
  root.classList.add("script");

  function make(name, attributes, parent, text) {
    var element = document.createElementNS(SVG, name);
    Object.keys(attributes).forEach(function (key) { element.setAttribute(key, attributes[key]); });
    if (text !== undefined) { element.textContent = text; }
    return parent.appendChild(element);
  }
  function numbers(text) { return text.split(" ").map(Number); }
  function number(value) { return String(Number(value.toPrecision(4))).replace("-", "\u2212"); }
  function between(value, low, high) { return Math.max(low, Math.min(high, value)); }
  function nearest(values, wanted) {
    var best = 0;
    values.forEach(function (value, k) { if (Math.abs(value - wanted) < Math.abs(values[best] - wanted)) { best = k; } });
    return best;
  }

  // Round numbers for an axis, as in charts.py.
  function ticks(low, high, count) {
    var raw = (high - low) / count, power = Math.pow(10, Math.floor(Math.log10(raw))), found = [];
    var step = power * [1, 2, 5, 10].find(function (factor) { return factor * power >= raw * 0.7; });
    var decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    for (var k = Math.ceil(low / step - 1e-9); k <= Math.floor(high / step + 1e-9); k += 1) {
      found.push([k * step, (k * step + 0).toFixed(decimals).replace("-", "\u2212")]);
    }
    return found;
  }

  // One picture: "view" holds the limits that are shown, left, right, bottom, top, in units of the data.
  function Picture(figure) {
    this.figure = figure;
    this.svg = figure.querySelector("svg.plot");
    this.axes = this.svg.querySelector(".axes");
    this.drawn = this.axes.querySelector(".drawn");
    this.scale = this.axes.querySelector(".scale");
    this.frame = numbers(this.axes.dataset.frame);
    this.full = this.view = numbers(this.axes.dataset.limits);
    this.item = data[figure.dataset.key];
    // values may be the key of another picture that has the same
    if (this.item && typeof this.item.values === "string") { this.item.values = data[this.item.values].values; }
  }
  Picture.prototype.placeOf = function (x, y, limits) {
    var f = this.frame, l = limits || this.view;
    return [f[0] + (x - l[0]) / (l[1] - l[0]) * (f[2] - f[0]), f[3] - (y - l[2]) / (l[3] - l[2]) * (f[3] - f[1])];
  };
  Picture.prototype.valueAt = function (px, py) {
    var f = this.frame, l = this.view;
    return [l[0] + (px - f[0]) / (f[2] - f[0]) * (l[1] - l[0]), l[2] + (f[3] - py) / (f[3] - f[1]) * (l[3] - l[2])];
  };
  Picture.prototype.pointOf = function (event) {
    var at = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [at.x, at.y];
  };
  Picture.prototype.isInside = function (p) {
    var f = this.frame;
    return p[0] >= f[0] - 6 && p[0] <= f[2] + 6 && p[1] >= f[1] - 6 && p[1] <= f[3] + 6;
  };
  Picture.prototype.isZoomed = function () { return this.view !== this.full; };
  Picture.prototype.show = function (limits) {
    var f = this.frame, full = this.full;
    if (limits !== full && (limits[1] - limits[0] < 1e-4 * (full[1] - full[0]) || limits[3] - limits[2] < 1e-4 * (full[3] - full[2]))) { return; }
    this.view = limits;
    var sx = (full[1] - full[0]) / (limits[1] - limits[0]), sy = (full[3] - full[2]) / (limits[3] - limits[2]);
    var corner = this.placeOf(limits[0], limits[2], full);
    this.drawn.setAttribute("transform", "matrix(" + [sx, 0, 0, sy, f[0] - sx * corner[0], f[3] - sy * corner[1]].join(" ") + ")");
    this.drawn.querySelectorAll("text").forEach(function (text) {
      var x = Number(text.getAttribute("x")), y = Number(text.getAttribute("y"));
      text.setAttribute("transform", "matrix(" + [1 / sx, 0, 0, 1 / sy, x - x / sx, y - y / sy].join(" ") + ")");
    });
    if (this.scale) { this.drawScale(); }
    this.figure.classList.toggle("zoomed", this.isZoomed());
    this.hide();
  };
  Picture.prototype.drawScale = function () {
    var f = this.frame, l = this.view, self = this, grid = "", texts = [];
    ticks(l[0], l[1], between(Math.floor((f[2] - f[0]) / 40), 2, 6)).forEach(function (tick) {
      var x = self.placeOf(tick[0], l[2])[0];
      grid += "M" + x + " " + f[1] + "V" + f[3];
      texts.push([{ x: x, y: f[3] + 10.8, "text-anchor": "middle" }, tick[1]]);
    });
    ticks(l[2], l[3], between(Math.floor((f[3] - f[1]) / 24), 2, 6)).forEach(function (tick) {
      var y = self.placeOf(l[0], tick[0])[1];
      grid += "M" + f[0] + " " + y + "H" + f[2];
      texts.push([{ x: f[0] - 4, y: y + 3.2, "text-anchor": "end" }, tick[1]]);
    });
    this.scale.querySelector("path").setAttribute("d", grid);
    this.scale.querySelectorAll("text").forEach(function (text) { text.remove(); });
    texts.forEach(function (text) { make("text", text[0], self.scale, text[1]).style.fill = "var(--ink)"; });
  };
  // Zoom by a factor around a place; a negative exponent shows more.
  Picture.prototype.zoomAt = function (at, factor) {
    var l = this.view, full = this.full;
    var x0 = Math.max(full[0], at[0] - (at[0] - l[0]) / factor), x1 = Math.min(full[1], at[0] + (l[1] - at[0]) / factor);
    var y0 = Math.max(full[2], at[1] - (at[1] - l[2]) / factor), y1 = Math.min(full[3], at[1] + (l[3] - at[1]) / factor);
    var whole = x1 - x0 > 0.999 * (full[1] - full[0]) && y1 - y0 > 0.999 * (full[3] - full[2]);
    this.show(whole ? full : [x0, x1, y0, y1]);
  };
  // Zoom to a rectangle of the picture; a thin one chooses a range of one axis only.
  Picture.prototype.zoomTo = function (a, b) {
    var f = this.frame, wide = Math.abs(a[0] - b[0]) > 5, high = Math.abs(a[1] - b[1]) > 5;
    if (!wide && !high) { return; }
    var left = wide ? Math.min(a[0], b[0]) : f[0], right = wide ? Math.max(a[0], b[0]) : f[2];
    var top = high ? Math.min(a[1], b[1]) : f[1], bottom = high ? Math.max(a[1], b[1]) : f[3];
    if (this.axes.dataset.bare) {  // pictures in space keep one scale for both directions
      var share = Math.max((right - left) / (f[2] - f[0]), (bottom - top) / (f[3] - f[1]));
      var x = (left + right) / 2, y = (top + bottom) / 2, w = share * (f[2] - f[0]) / 2, h = share * (f[3] - f[1]) / 2;
      left = x - w; right = x + w; top = y - h; bottom = y + h;
    }
    var low = this.valueAt(left, bottom), up = this.valueAt(right, top);
    this.show([low[0], up[0], low[1], up[1]]);
  };

  // A text beside the pointer and a mark at the value that it is about.
  Picture.prototype.say = function (at, text, x, y) {
    var mark = this.svg.querySelector(".mark") || make("circle", { "class": "mark", r: "4" }, this.svg);
    mark.setAttribute("cx", at[0]);
    mark.setAttribute("cy", at[1]);
    tip.textContent = text;
    tip.hidden = false;
    tip.style.left = between(x + 14, 4, window.innerWidth - tip.offsetWidth - 8) + "px";
    tip.style.top = between(y + 14, 4, window.innerHeight - tip.offsetHeight - 8) + "px";
  };
  Picture.prototype.hide = function () {
    var mark = this.svg.querySelector(".mark");
    if (mark) { mark.remove(); }
    if (tip) { tip.hidden = true; }
  };
  // Series of a control that is not shown are left out.
  function isShown(series) {
    var chosen = root.dataset.control;
    return series.control === undefined || !chosen || chosen === "all" || chosen === String(series.control);
  }
  Picture.prototype.sayCurve = function (index, x, y) {
    var first = this.item.series[0], at = first.x[index], lines = [number(at) + " " + (this.item.units && this.item.units[0] === "mm" ? LENGTH : "")];
    this.item.series.forEach(function (series) {
      var k = series.x.findIndex(function (other) { return Math.abs(other - at) < 1e-6; });
      if (k < 0 || series.y[k] === null || !isShown(series)) { return; }
      var more = series.U && series.U[k] !== null ? " \u00b1 " + number(series.U[k]) : "";
      lines.push(series.name + ": " + number(series.y[k]) + more);
    });
    this.figure.dataset.index = index;
    this.say(this.placeOf(at, first.y[index] || 0), lines.join("\n"), x, y);
  };
  Picture.prototype.sayCell = function (value, x, y) {
    var n = this.item.cells, l = this.full, axes = this.item.axes;
    var i = between(Math.floor((value[0] - l[0]) / (l[1] - l[0]) * n[0]), 0, n[0] - 1);
    var j = between(Math.floor((value[1] - l[2]) / (l[3] - l[2]) * n[1]), 0, n[1] - 1);
    var v = this.item.values[j * n[0] + i];
    var across = l[0] + (i + 0.5) / n[0] * (l[1] - l[0]), up = l[2] + (j + 0.5) / n[1] * (l[3] - l[2]);
    this.say(this.placeOf(across, up), axes[0] + " " + number(across) + ", " + axes[1] + " " + number(up) + " " + LENGTH + "\n" +
      number(Math.hypot(v[0], v[1], v[2])) + " " + DEVIATION + ": X " + number(v[0]) + ", Y " + number(v[1]) + ", Z " + number(v[2]), x, y);
  };

  Picture.prototype.listen = function () {
    var self = this, figure = this.figure, start = null, box = null;
    var zooms = !this.axes.dataset.fixed;
    this.svg.addEventListener("pointermove", function (event) {
      var p = self.pointOf(event), f = self.frame;
      if (start) {
        box = box || make("rect", { "class": "chosen" }, self.svg);
        var a = [between(p[0], f[0], f[2]), between(p[1], f[1], f[3])];
        box.setAttribute("x", Math.min(a[0], start[0]));
        box.setAttribute("y", Math.min(a[1], start[1]));
        box.setAttribute("width", Math.abs(a[0] - start[0]));
        box.setAttribute("height", Math.abs(a[1] - start[1]));
        return;
      }
      if (!self.item || !self.isInside(p)) { self.hide(); return; }
      var value = self.valueAt(p[0], p[1]);
      if (self.item.series) { self.sayCurve(nearest(self.item.series[0].x, value[0]), event.clientX, event.clientY); }
      if (self.item.cells) { self.sayCell(value, event.clientX, event.clientY); }
    });
    this.svg.addEventListener("pointerleave", function () { self.hide(); });
    figure.addEventListener("blur", function () { self.hide(); });
    if (zooms) {
      this.svg.addEventListener("pointerdown", function (event) {
        var p = self.pointOf(event);
        if (event.button || event.pointerType === "touch" || !self.isInside(p)) { return; }
        start = p;
        self.svg.setPointerCapture(event.pointerId);
        event.preventDefault();
        figure.focus({ preventScroll: true });
      });
      this.svg.addEventListener("pointerup", function (event) {
        if (box) { box.remove(); self.zoomTo(start, self.pointOf(event)); }
        start = box = null;
      });
      this.svg.addEventListener("pointercancel", function () { if (box) { box.remove(); } start = box = null; });
      this.svg.addEventListener("wheel", function (event) {
        if (!event.ctrlKey) { return; }
        var p = self.pointOf(event);
        event.preventDefault();
        self.zoomAt(self.valueAt(p[0], p[1]), event.deltaY < 0 ? 1.25 : 0.8);
      }, { passive: false });
    }
    figure.addEventListener("dblclick", function (event) {
      if (!self.isZoomed()) { return; }
      self.show(self.full);
      event.stopImmediatePropagation();  // it does not make the picture large as well
    });
    figure.addEventListener("keydown", function (event) {
      var step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], l = self.view, series = self.item && self.item.series;
      if (event.key === "Escape") { if (self.isZoomed()) { self.show(self.full); } self.hide(); return; }
      if (zooms && (event.key === "+" || event.key === "-")) {
        var index = Number(figure.dataset.index || 0);
        var at = series && figure.dataset.index ? [series[0].x[index], series[0].y[index] || 0] : [(l[0] + l[1]) / 2, (l[2] + l[3]) / 2];
        self.zoomAt(at, event.key === "+" ? 1.5 : 1 / 1.5);
      }
      if (!step || !series) { return; }
      event.preventDefault();
      var place = figure.getBoundingClientRect();
      self.sayCurve(between(Number(figure.dataset.index || 0) + step, 0, series[0].x.length - 1), place.left + 20, place.top + 20);
    });
  };
  document.querySelectorAll("figure.picture").forEach(function (figure) { new Picture(figure).listen(); });

  // layers of the picture in space
  document.querySelectorAll("[data-views] button[data-layer]").forEach(function (button) {
    button.addEventListener("click", function () {
      var shown = button.closest("[data-views]").classList.toggle("show-" + button.dataset.layer);
      button.setAttribute("aria-pressed", String(shown));
    });
  });
})();
