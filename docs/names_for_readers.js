// Names for those who hear the site, and the keyboard for what scrolls: the theme has neither.
function complete() {
  document.querySelector(".md-search")?.setAttribute("aria-label", "Search");
  document.querySelectorAll(".md-code__nav").forEach((part, k) => part.setAttribute("aria-label", `Code ${k + 1}`));
  for (const part of document.querySelectorAll('.md-typeset__scrollwrap, math[display="block"]')) part.setAttribute("tabindex", "0");
}
new MutationObserver(complete).observe(document.body, { childList: true, subtree: true });
complete();
