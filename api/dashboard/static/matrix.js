// Choosing cells of a matrix: a press on a head takes its row or column, and the bar below says how many are chosen.
(() => {
  "use strict";
  const boxes = (form) => [...form.querySelectorAll("input[name=cell]")];

  function tell(form) {
    const count = boxes(form).filter((box) => box.checked).length;
    form.querySelector("[data-chosen]").textContent = count ? `${count} ${count === 1 ? "cell" : "cells"} chosen` : "Choose cells";
    for (const button of form.querySelectorAll("button[name=action]")) button.disabled = count === 0;
  }

  for (const form of document.querySelectorAll("form[data-cells]")) {
    form.addEventListener("change", () => tell(form));
    form.addEventListener("click", (event) => {
      const head = event.target.closest("button[data-row], button[data-column]");
      if (!head) return;
      const wanted = head.dataset.column === undefined
        ? [...head.closest("tr").querySelectorAll("input[name=cell]")]
        : boxes(form).filter((box) => box.dataset.column === head.dataset.column);
      const on = wanted.some((box) => !box.checked);
      wanted.forEach((box) => { box.checked = on; });
      tell(form);
    });
    // A refresh brings fresh boxes: what was chosen stays chosen.
    let kept = new Set();
    document.addEventListener("graspd:swapping", () => { kept = new Set(boxes(form).filter((box) => box.checked).map((box) => box.value)); });
    document.addEventListener("graspd:swapped", () => { boxes(form).forEach((box) => { box.checked = kept.has(box.value); }); tell(form); });
    tell(form);
  }
})();
