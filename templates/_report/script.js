(function () {
  var root = document.documentElement;
  function all(selector, base) { return Array.prototype.slice.call((base || document).querySelectorAll(selector)); }

  // light and dark
  var theme = document.getElementById("theme");
  var wanted = window.matchMedia("(prefers-color-scheme: dark)");
  function isDark() { return root.dataset.theme ? root.dataset.theme === "dark" : wanted.matches; }
  function nameTheme() { theme.setAttribute("aria-pressed", String(isDark())); }
  theme.addEventListener("click", function () { root.dataset.theme = isDark() ? "light" : "dark"; nameTheme(); });
  wanted.addEventListener("change", nameTheme);
  nameTheme();

  // a page of no origin, as the workbench shows it, cannot open a window to print
  var print = document.getElementById("print");
  print.addEventListener("click", function () { window.print(); });
  print.hidden = window.location.protocol !== "file:" && window.origin === "null";

  // which control is shown, and printed
  var chooser = document.getElementById("control");
  function showControl(number) {
    root.dataset.control = number;
    all(".control").forEach(function (part) { part.style.display = number === "all" || part.classList.contains("control-" + number) ? "block" : "none"; });
    all(".layer").forEach(function (part) {
      var found = /layer-control-(\d+)/.exec(part.getAttribute("class"));
      if (found) { part.style.display = number === "all" || found[1] === number ? "inline" : "none"; }
    });
  }
  if (chooser) { chooser.addEventListener("change", function () { showControl(chooser.value); }); showControl(chooser.value); }

  // one picture across the whole page
  var error = document.getElementById("error");
  function enlarge(key) {
    all(".picture.large").forEach(function (figure) { figure.classList.remove("large"); });
    var figure = key && document.getElementById("figure-" + key);
    if (figure) { figure.classList.add("large"); figure.scrollIntoView({ block: "nearest" }); }
    if (error) { error.value = all("option", error).some(function (option) { return option.value === key; }) ? key : ""; }
  }
  if (error) { error.addEventListener("change", function () { enlarge(error.value); }); }
  all(".grid .picture").forEach(function (figure) {
    function turn() { enlarge(figure.classList.contains("large") ? "" : figure.dataset.key); }
    figure.addEventListener("dblclick", turn);
    figure.addEventListener("keydown", function (event) { if (event.key === "Enter") { turn(); } });
  });

  // what is folded is printed, but for long lists of numbers
  var opened = [];
  window.addEventListener("beforeprint", function () {
    opened = all("details:not([open]):not(.long)");
    opened.forEach(function (part) { part.open = true; });
  });
  window.addEventListener("afterprint", function () { opened.forEach(function (part) { part.open = false; }); });
  root.dataset.ready = "1";
})();
