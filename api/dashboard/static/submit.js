// Selected files are uploaded and checked immediately, so that the form shows the result before the submission. A refused file
// disables the button until a change of its units or a fix passes the check. Without this script the form sends the files.
(() => {
  "use strict";
  const POLL_MS = 400;
  const PATIENCE_MS = 60000;
  // A proxy may serve the service under a path.
  const root = new URL("..", document.currentScript.src).pathname;
  const form = document.getElementById("job");
  const button = form.querySelector("button.primary");
  const blocked = document.getElementById("blocked");
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  // With a key of scope read the button stays disabled, regardless of uploads.
  const readonly = button.disabled;
  const waiting = new Map();

  async function document_(answer) {
    const body = await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Error(body.detail ?? `the upload failed (HTTP ${answer.status})`);
    return body;
  }

  async function check(kind, file, options) {
    const data = new FormData();
    data.append("file", file);
    // Files with different content are different objects, even under the same name.
    data.append("rename", "true");
    if (Object.keys(options).length) data.append("options", JSON.stringify(options));
    let asset = await document_(await fetch(`${root}v1/${kind}s`, { method: "POST", body: data }));
    const until = Date.now() + PATIENCE_MS;
    while (asset.verdict === null && Date.now() < until) {
      await pause(POLL_MS);
      asset = await document_(await fetch(`${root}v1/${kind}s/${asset.digest}`));
    }
    if (asset.verdict === "refuse") {
      const page = await fetch(`${root}submit/refusals/${kind}/${asset.digest}`);
      // HTML with the reason, and buttons of fixes.
      throw Object.assign(new Error(asset.message), { page: page.ok ? await page.text() : "" });
    }
    return asset;
  }

  /** Disable the button with a reason, or enable it. */
  function hold(thing, why) {
    if (why) waiting.set(thing, why); else waiting.delete(thing);
    button.disabled = readonly || waiting.size > 0;
    blocked.textContent = [...waiting.values()][0] ?? "";
  }

  function wire(thing) {
    const kind = thing.dataset.thing;
    const input = thing.querySelector("input[type=file]");
    const units = thing.querySelector(".ways");
    const said = thing.querySelector("[data-found]");
    const select = thing.querySelector(`select[name=${kind}]`);
    const figure = thing.querySelector("figure");
    // File of the form, checked or not.
    let held = null;
    let fixes = {};
    let round = 0;
    const say = (text, state) => { said.textContent = text; said.dataset.state = state; };

    function show(value, text, model) {
      for (const own of select.querySelectorAll("option[data-own], option[value='']")) own.remove();
      if (![...select.options].some((option) => option.value === value)) {
        const option = new Option(text, value);
        option.dataset.own = "";
        select.add(option, 0);
      }
      select.value = value;
      figure.querySelector("[data-say]").textContent = model ? "" : text;
      figure.dataset.model = model;
      form.dispatchEvent(new Event("picked"));
    }

    async function upload() {
      if (!held) return;
      const [file, mine] = [held, ++round];
      const unit = units ? form.elements.units.value : "m";
      const options = unit === "m" ? fixes : { ...fixes, units: unit };
      say(`Checking ${file.name}`, "busy");
      show("", `${file.name} (being checked)`, "");
      hold(thing, `${file.name} is being checked.`);
      try {
        const asset = await check(kind, file, options);
        if (mine !== round) return;
        // The store has the file: the form need not send it again.
        input.value = "";
        show(asset.name, asset.name, `${root}v1/${kind}s/${asset.digest}/model`);
        say(asset.verdict ? asset.message : "no worker has checked it yet; start one before you submit", "good");
        hold(thing, "");
      } catch (error) {
        if (mine !== round) return;
        show("", `${file.name} (refused)`, "");
        say(error.message, "bad");
        if (error.page) said.innerHTML = error.page;
        hold(thing, `${file.name} was refused: fix it, or select a known ${kind}.`);
      }
    }

    input.addEventListener("change", () => {
      // A cancelled dialog empties the field; the form still refers to the file.
      if (!input.files[0]) return;
      [held, fixes] = [input.files[0], {}];
      thing.querySelector("[data-refused]")?.remove();
      upload();
    });
    said.addEventListener("click", (event) => {
      const button = event.target.closest(`button[name=${kind}_fix]`);
      if (!button) return;
      event.preventDefault();
      for (const [key, value] of Object.entries(JSON.parse(button.value))) {
        const field = said.querySelector(`input[name=${kind}_${key}]`);
        if (key === "units" && units) form.elements.units.value = value;
        else if (value !== null) fixes[key] = typeof value === "object" ? { ...fixes[key], ...value } : value;
        else if (field.value === "" || !field.reportValidity()) return field.focus();
        else fixes[key] = key === "scale_to" ? Number(field.value) / 1000 : field.value;
      }
      upload();
    });
    // Enter in the field of a fix presses the button of the fix, not of the form.
    said.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || !event.target.matches("input")) return;
      event.preventDefault();
      event.target.closest(".inline").querySelector("button").click();
    });
    units?.addEventListener("change", upload);
    select.addEventListener("change", () => {
      round += 1;
      [held, input.value] = [null, ""];
      select.querySelector("option[data-own]:not(:checked)")?.remove();
      figure.querySelector("[data-say]").textContent = "";
      figure.dataset.model = select.value ? `${root}v1/${kind}s/${encodeURIComponent(select.value)}/model` : "";
      say("", "");
      hold(thing, "");
    });
    // Browsers restore the selection on return to a page; the picture must match it.
    window.addEventListener("pageshow", (event) => { if (event.persisted && !held) select.dispatchEvent(new Event("change")); });
  }

  document.querySelectorAll("[data-thing]").forEach(wire);
  // A closed group would hide an invalid field from the browser's message.
  form.addEventListener("invalid", (event) => { const group = event.target.closest("details"); if (group) group.open = true; }, true);
  form.addEventListener("submit", (event) => { if (waiting.size) event.preventDefault(); });
})();
