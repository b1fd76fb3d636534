for (const panel of document.querySelectorAll(".panels:not(.single) > .panel")) {
  panel.title = "click: larger, again: smaller";
  panel.classList.add("zoomable");
  panel.addEventListener("click", () => panel.classList.toggle("large"));
}
