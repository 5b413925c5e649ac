// Choosing an object marks it in the pictures, the graph, the table and the view; wide tables say that they go on.
"use strict";
(() => {
  const all = selector => [...document.querySelectorAll(selector)];
  let chosen = null;
  function choose(name) {
    chosen = name === chosen ? null : name;
    for (const element of all("[data-object]")) {
      const on = element.dataset.object === chosen;
      element.classList.toggle("chosen", on);
      if (element.hasAttribute("aria-pressed")) element.setAttribute("aria-pressed", String(on));
    }
    const view = document.getElementById("scene");
    if (view) view.dispatchEvent(new CustomEvent("choose", {detail: chosen}));
  }
  document.addEventListener("click", event => {
    const element = event.target.closest("button[data-object], g[data-object], tr[data-object]");
    if (element) choose(element.dataset.object);
  });
  document.addEventListener("keydown", event => {
    if (event.key === "Escape" && chosen) choose(chosen);
    const node = event.target.closest && event.target.closest("g[role=button]");
    if (node && (event.key === "Enter" || event.key === " ")) { event.preventDefault(); choose(node.dataset.object); }
  });
  const tell = () => {
    for (const box of all(".scroll")) {
      const more = box.nextElementSibling;
      const wide = box.scrollWidth - box.clientWidth > 2;
      if (more && more.classList.contains("more")) more.hidden = !wide || box.scrollLeft + box.clientWidth >= box.scrollWidth - 2;
    }
  };
  for (const box of all(".scroll")) box.addEventListener("scroll", tell);
  window.addEventListener("resize", tell);
  tell();
})();
