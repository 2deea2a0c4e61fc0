"use strict";
// What the pages of the workbench do in the browser: they say that they are open, show the progress of a command, take
// dropped files, and draw the chain of a machine while it is typed. Everything else is made by the server.
(function () {
  var body = document.body, root = document.documentElement;
  var csrf = body.dataset.csrf, project = body.dataset.project;

  function send(path, values, leaving) {
    var form = new FormData();
    form.append("csrf", csrf);
    Object.keys(values).forEach(function (key) { form.append(key, values[key]); });
    if (leaving) { navigator.sendBeacon(path, form); return Promise.resolve(); }
    return fetch(path, { method: "POST", body: form }).catch(function () {});
  }

  // light and dark
  var theme = document.getElementById("theme"), wanted = window.matchMedia("(prefers-color-scheme: dark)");
  function isDark() { return root.dataset.theme ? root.dataset.theme === "dark" : wanted.matches; }
  function nameTheme() { theme.setAttribute("aria-pressed", String(isDark())); }
  try { if (localStorage.getItem("theme")) { root.dataset.theme = localStorage.getItem("theme"); } } catch (error) { /* not kept */ }
  theme.addEventListener("click", function () {
    root.dataset.theme = isDark() ? "light" : "dark";
    try { localStorage.setItem("theme", root.dataset.theme); } catch (error) { /* not kept */ }
    nameTheme();
  });
  nameTheme();

  // the program ends when the last page is closed
  function newName() { return Array.from(crypto.getRandomValues(new Uint32Array(3))).join("-"); }
  var page = newName();
  function alive() { send("/alive", { page: page }); }
  alive();
  setInterval(alive, 20000);
  window.addEventListener("pageshow", function (event) { if (event.persisted) { page = newName(); alive(); } });
  window.addEventListener("pagehide", function () { send("/alive", { page: page, left: "yes" }, true); });

  // progress, and changes by another window
  var job = document.getElementById("job"), stale = document.getElementById("stale"), busy = body.dataset.busy === "yes";
  function ask() {
    fetch("/projects/" + project + "/status").then(function (answer) { return answer.json(); }).then(function (status) {
      if (busy && !status.busy) { location.reload(); return; }
      if (status.busy) {
        job.hidden = false;
        document.getElementById("job-title").textContent = status.title;
        document.getElementById("job-line").textContent = status.line;
        document.getElementById("job-seconds").textContent = status.seconds.toFixed(0) + " s";
      } else if (String(status.revision) !== body.dataset.revision) { stale.hidden = false; }
      if (status.busy && !busy) { stale.hidden = false; }
      setTimeout(ask, busy ? 500 : 3000);
    }).catch(function () { setTimeout(ask, 3000); });
  }
  if (project) {
    stale.querySelector("a").href = location.pathname;
    setTimeout(ask, busy ? 300 : 3000);
  }

  // files that are dropped become those of the form
  document.querySelectorAll("[data-drop]").forEach(function (form) {
    var input = form.querySelector("input[type=file]");
    ["dragenter", "dragover"].forEach(function (name) {
      form.addEventListener(name, function (event) { event.preventDefault(); form.classList.add("over"); });
    });
    form.addEventListener("dragleave", function () { form.classList.remove("over"); });
    form.addEventListener("drop", function (event) {
      event.preventDefault();
      form.classList.remove("over");
      if (event.dataTransfer.files.length) {
        input.files = event.dataTransfer.files;
        if (!form.querySelector("select")) { form.requestSubmit(); }
      }
    });
  });
  // a file dropped beside a form must not replace the page
  ["dragover", "drop"].forEach(function (name) { document.addEventListener(name, function (event) { event.preventDefault(); }); });

  // what was typed is written again into the form whose command was refused
  var typed = "input:not([type=hidden]):not([type=file]), select, textarea", refused = document.querySelector("main > .message.bad");
  function remembered(form) {
    try { return JSON.parse(sessionStorage.getItem("form " + form.action)) || []; } catch (error) { return []; }
  }
  document.querySelectorAll("form").forEach(function (form) {
    if (refused) {
      var fields = form.querySelectorAll(typed);
      remembered(form).forEach(function (value, k) {
        if (!fields[k]) { return; }
        if (typeof value === "boolean") { fields[k].checked = value; } else { fields[k].value = value; }
      });
    }
    form.addEventListener("submit", function () {
      var values = Array.from(form.querySelectorAll(typed)).map(function (field) {
        return field.type === "checkbox" || field.type === "radio" ? field.checked : field.value;
      });
      try { sessionStorage.setItem("form " + form.action, JSON.stringify(values)); } catch (error) { /* not kept */ }
    });
  });

  // files that are larger than what the program takes are refused before they are sent
  document.querySelectorAll("form[enctype]").forEach(function (form) {
    form.addEventListener("submit", function (event) {
      var size = 0, told = document.getElementById("large");
      form.querySelectorAll("input[type=file]").forEach(function (input) {
        Array.from(input.files).forEach(function (file) { size += file.size; });
      });
      told.hidden = size <= Number(body.dataset.most);
      if (told.hidden) { return; }
      event.preventDefault();
      event.stopImmediatePropagation();
      told.querySelector("strong").textContent = Math.ceil(size / 1e6);
      form.append(told);
    });
  });

  // a button is pressed once
  document.querySelectorAll("form").forEach(function (form) {
    form.addEventListener("submit", function () {
      setTimeout(function () { form.querySelectorAll("button").forEach(function (button) { button.disabled = true; }); }, 0);
    });
  });
  window.addEventListener("pageshow", function () {
    document.querySelectorAll("button[disabled]").forEach(function (button) { button.disabled = false; });
  });

  // the chain, while it is typed: its drawing, and what the words can mean
  var chain = document.getElementById("chain"), drawing = document.getElementById("drawing"), waiting = 0;
  function draw(words, fits) {
    fetch("/chain?words=" + encodeURIComponent(words)).then(function (answer) {
      return answer.status === 200 ? answer.json() : null;
    }).then(function (found) {
      if (!found) { return; }
      var svg = new DOMParser().parseFromString(found.drawing, "text/html").querySelector("svg");
      drawing.replaceChildren(document.importNode(svg, true));
      drawing.classList.remove("example");
      if (fits) { fits(found.fits); }
    }).catch(function () {});
  }
  function list(fits) {
    var meaning = document.getElementById("meaning");
    document.getElementById("which").hidden = fits.length < 2;
    meaning.replaceChildren.apply(meaning, fits.map(function (fit, k) {
      var label = document.createElement("label"), input = document.createElement("input");
      label.className = "check";
      if (fits.length > 1) {
        input.type = "radio"; input.name = "fit"; input.value = fit[0]; input.checked = k === 0;
        input.addEventListener("change", function () { draw(fit[0]); });
        label.append(input);
      }
      label.append(fit[1] + " (" + fit[0] + ")");
      return label;
    }));
  }
  if (chain) {
    chain.addEventListener("input", function () {
      clearTimeout(waiting);
      waiting = setTimeout(function () { draw(chain.value, list); }, 150);
    });
    if (chain.value) { draw(chain.value, list); }  // also what was typed before a refusal
  }
})();
