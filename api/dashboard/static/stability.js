// Failure maps: the text below a map describes the cell under the pointer.
(() => {
  "use strict";
  function say(event) {
    const cell = event.target.closest?.(".cells td[title]");
    if (!cell) return;
    const reading = cell.closest(".failure").querySelector("[data-reading]");
    for (const other of document.querySelectorAll("[data-reading]")) if (other !== reading) other.textContent = "";
    reading.textContent = `${cell.closest("figure").querySelector("figcaption").textContent}: ${cell.title}`;
    document.querySelector(".cells .shown")?.classList.remove("shown");
    cell.classList.add("shown");
  }
  document.addEventListener("pointerover", say);
  document.addEventListener("click", say);
})();
