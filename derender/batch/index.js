"use strict";
(() => {
  const form = document.querySelector("form"), body = document.querySelector("tbody");
  const status = document.querySelector("[role=status]"), rows = [...body.rows];
  const show = () => {
    const state = form.elements.state.value, words = form.elements.words.value.toLowerCase().split(/\s+/);
    let shown = 0;
    for (const row of rows) {
      const fits = (!state || row.dataset.state === state) && words.every((word) => row.dataset.words.includes(word));
      row.hidden = !fits;
      shown += fits;
    }
    status.textContent = `${shown} of ${rows.length} shown`;
  };
  form.addEventListener("input", show);
  form.addEventListener("submit", (event) => event.preventDefault());
  document.querySelectorAll("thead button").forEach((button, number) => {
    button.addEventListener("click", () => {
      const head = button.parentElement, down = head.getAttribute("aria-sort") === "ascending";
      for (const other of head.parentElement.cells) other.hasAttribute("aria-sort") && other.setAttribute("aria-sort", "none");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (row) => row.cells[number + 1].dataset.key;
      rows.sort((a, b) => key(a).localeCompare(key(b), "en", { numeric: true }) * (down ? -1 : 1));
      body.append(...rows);
    });
  });
  show();
})();
