// Selection of cells of a matrix, or of grasps of a list. A heading selects its row or column, one box selects all, and
// a bar shows how many are selected. `data-choose` of a form is the name of its boxes.
(() => {
  "use strict";
  const boxes = (form) => [...form.querySelectorAll(`input[name="${form.dataset.choose}"][type=checkbox]`)];
  const forms = () => document.querySelectorAll("form[data-choose]");

  function tell(form) {
    const what = form.dataset.choose, count = boxes(form).filter((box) => box.checked).length;
    const all = form.querySelector("input[name=all]"), every = form.querySelector("input[data-every]");
    const said = all?.checked ? all.dataset.said : count ? `${count} ${what}${count === 1 ? "" : "s"} selected` : `Select ${what}s`;
    form.querySelector("[data-chosen]").textContent = said;
    for (const button of form.querySelectorAll("button[data-acts]")) {
      const [least, most] = (button.dataset.few ?? "1-Infinity").split("-").map(Number);
      button.disabled = button.dataset.few ? count < least || count > most : count === 0 && !all?.checked;
    }
    if (every) {
      every.checked = count > 0 && count === boxes(form).length;
      every.indeterminate = count > 0 && !every.checked;
    }
  }

  // Sliders over a histogram write their values into the fields of the form; an end of the range is no filter.
  document.addEventListener("input", (event) => {
    const slider = event.target;
    if (!slider.matches("[data-range] input[type=range]")) return;
    const place = slider.dataset.end === "min" ? 0 : 1, field = slider.closest("fieldset").querySelectorAll("input[name]")[place];
    field.value = slider.value === (place ? slider.max : slider.min) ? "" : Number(Number(slider.value).toPrecision(3));
  });
  document.addEventListener("change", (event) => {
    if (event.target.matches("[data-range] input, .sorting select")) document.getElementById("filters").requestSubmit();
    const form = event.target.closest("form[data-choose]");
    if (!form) return;
    if (event.target.matches("input[data-every]")) boxes(form).forEach((box) => { box.checked = event.target.checked; });
    tell(form);
  });
  document.addEventListener("click", (event) => {
    const head = event.target.closest("form[data-choose] :is(button[data-row], button[data-column])");
    if (!head) return;
    const form = head.closest("form");
    const wanted = head.dataset.column === undefined
      ? [...head.closest("tr").querySelectorAll(`input[name="${form.dataset.choose}"]`)]
      : boxes(form).filter((box) => box.dataset.column === head.dataset.column);
    const on = wanted.some((box) => !box.checked);
    wanted.forEach((box) => { box.checked = on; });
    tell(form);
  });
  // A refresh replaces the boxes; the selection is restored.
  let kept = new Set();
  document.addEventListener("graspd:swapping", () => {
    kept = new Set([...forms()].flatMap((form) => boxes(form).filter((box) => box.checked).map((box) => box.value)));
  });
  document.addEventListener("graspd:swapped", () => {
    for (const form of forms()) {
      boxes(form).forEach((box) => { box.checked = kept.has(box.value); });
      tell(form);
    }
  });
  document.addEventListener("htmx:after:swap", () => forms().forEach(tell));
  forms().forEach(tell);
})();
