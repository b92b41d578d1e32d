// Files of a job's form: htmx sends a chosen file at once and shows the result of its check. Meanwhile, and while a file
// is refused, the form cannot be submitted. Without this script the form sends the files.
(() => {
  "use strict";
  const form = document.getElementById("job");
  const button = form.querySelector("button.primary");
  // With a key of scope read the button stays disabled, regardless of files.
  const readonly = button.disabled;

  function update() {
    const why = form.querySelector("[data-blocks]:not([data-blocks=''])")?.dataset.blocks ?? "";
    document.getElementById("blocked").textContent = why;
    button.disabled = readonly || why !== "";
  }

  /** State of a hand's or object's file before, or without, an answer; a reason in `blocks` disables the button. */
  function say(fields, text, state, blocks) {
    const found = fields.querySelector("[data-found]");
    Object.assign(found, { textContent: text }).dataset.state = state;
    fields.dataset.blocks = blocks;
    update();
  }

  form.addEventListener("htmx:before:request", ({ target, detail: { ctx } }) => {
    const fields = target.closest("[data-thing] .fields");
    if (!fields) return;
    const file = fields.querySelector("[type=file]").files[0], name = file?.name ?? "The file";
    if (ctx.sourceEvent.target.matches("select") || !(file || fields.querySelector("[type=hidden]"))) return say(fields, "", "", "");
    fields.dataset.model = ""; // an old model must not look like the file
    say(fields, `Checking ${name}`, "busy", `${name} is being checked.`);
  });
  for (const kind of ["htmx:response:error", "htmx:error"]) {
    form.addEventListener(kind, ({ target, detail: { ctx } }) => {
      const fields = target.closest("[data-thing] .fields"), status = ctx?.response?.status;
      if (!fields) return;
      if (ctx) ctx.swap = "none";
      say(fields, `The upload failed${status ? ` (HTTP ${status})` : ""}`, "bad", "The file is not uploaded: choose it again, or select a known one.");
    });
  }
  form.addEventListener("htmx:after:swap", update);
  // Enter in the field of a fix presses the button of the fix; elsewhere it submits the form.
  form.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" || !event.target.matches("input:not([type=file])")) return;
    event.preventDefault();
    (event.target.closest(".inline")?.querySelector("button") ?? button).click();
  });
  // A closed group would hide an invalid field from the browser's message.
  form.addEventListener("invalid", (event) => { const group = event.target.closest("details"); if (group) group.open = true; }, true);
  update();
})();
