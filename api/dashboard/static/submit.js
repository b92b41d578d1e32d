// Uploads are sent and checked as soon as they are chosen, so that one sees what graspd made of them before submitting.
// Without this script the form sends the files itself.
(() => {
  "use strict";
  const POLL_MS = 400;
  const PATIENCE_MS = 60000;
  const form = document.getElementById("job");
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));

  async function document_(answer) {
    const body = await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Error(body.detail ?? `the upload failed (HTTP ${answer.status})`);
    return body;
  }

  async function check(kind, file, units) {
    const data = new FormData();
    data.append("file", file);
    if (kind === "object" && units && units !== "m") data.append("options", JSON.stringify({ units }));
    let asset = await document_(await fetch(`/v1/${kind}s`, { method: "POST", body: data }));
    const until = Date.now() + PATIENCE_MS;
    while (asset.verdict === null) {
      if (Date.now() > until) throw new Error("no worker has checked it yet; start one, or submit and let it wait");
      await pause(POLL_MS);
      asset = await document_(await fetch(`/v1/${kind}s/${asset.digest}`));
    }
    if (asset.verdict === "refuse") throw new Error(asset.message);
    return asset;
  }

  function choose(thing, kind, asset) {
    const select = thing.querySelector(`select[name=${kind}]`);
    if (![...select.options].some((option) => option.value === asset.name)) select.add(new Option(asset.name, asset.name));
    select.value = asset.name;
    thing.querySelector("figure").dataset.model = `/v1/${kind}s/${asset.digest}/model`;
    form.dispatchEvent(new Event("picked"));
  }

  function wire(thing) {
    const kind = thing.dataset.thing;
    const input = thing.querySelector("input[type=file]");
    const units = thing.querySelector("select[name=units]");
    const said = thing.querySelector("[data-found]");
    const say = (text, state) => { said.textContent = text; said.dataset.state = state; };
    thing.querySelector(`select[name=${kind}]`).addEventListener("change", (event) => {
      thing.querySelector("figure").dataset.model = `/v1/${kind}s/${encodeURIComponent(event.target.value)}/model`;
      say("", "");
    });
    async function upload() {
      const file = input.files[0];
      if (!file) return;
      say(`Checking ${file.name}`, "busy");
      input.disabled = true;
      try {
        const asset = await check(kind, file, units?.value);
        // The form must not send it a second time.
        input.value = "";
        choose(thing, kind, asset);
        say(asset.message, "good");
      } catch (error) {
        input.value = "";
        say(error.message, "bad");
      } finally {
        input.disabled = false;
      }
    }
    input.addEventListener("change", upload);
  }

  document.querySelectorAll("[data-thing]").forEach(wire);
})();
