// Live pages: after a server event, the page is fetched again, and its regions marked data-live are replaced.
// Without this script the pages have the same content, but do not change.
(() => {
  "use strict";
  const relative = new Intl.RelativeTimeFormat("en", { numeric: "auto", style: "short" });

  function sayTimes(root) {
    for (const element of root.querySelectorAll("time[datetime]")) {
      const seconds = (new Date(element.dateTime) - Date.now()) / 1000;
      const size = Math.abs(seconds);
      const [unit, length] = size < 60 ? ["second", 1] : size < 3600 ? ["minute", 60] : size < 86400 ? ["hour", 3600] : ["day", 86400];
      element.textContent = size < 5 ? "just now" : relative.format(Math.round(seconds / length), unit);
      element.title = new Date(element.dateTime).toLocaleString([], { dateStyle: "medium", timeStyle: "medium" });
    }
  }

  /** Element of a new region that replaces an element of the old region. */
  function twin(region, element) {
    const name = (attribute) => (element.getAttribute(attribute) ? `[${attribute}="${CSS.escape(element.getAttribute(attribute))}"]` : "");
    const mark = name("id") || `${name("name")}${name("value")}${name("href")}`;
    return mark ? region.querySelector(element.localName + mark) : null;
  }

  function swap(text) {
    let changed = false;
    document.dispatchEvent(new Event("graspd:swapping"));
    const fresh = new DOMParser().parseFromString(text, "text/html");
    for (const region of document.querySelectorAll("[data-live]")) {
      const next = fresh.getElementById(region.id);
      const focused = region.contains(document.activeElement) ? document.activeElement : null;
      // A region with a focused text field stays, to preserve the input.
      if (!next || focused?.matches("input:not([type=checkbox], [type=radio]), select")) continue;
      if (next.outerHTML === region.dataset.was) continue;
      const was = next.outerHTML;
      sayTimes(next);
      region.replaceWith(document.adoptNode(next));
      const shown = document.getElementById(next.id);
      shown.dataset.was = was;
      if (focused) twin(shown, focused)?.focus();
      changed = true;
    }
    if (changed) document.dispatchEvent(new Event("graspd:swapped"));
  }

  let pending = null;
  async function refresh() {
    pending = null;
    const answer = await fetch(location.href, { headers: { Accept: "text/html" } });
    if (answer.ok) swap(await answer.text());
  }

  function watch() {
    const source = new EventSource(document.body.dataset.events);
    const lamp = document.getElementById("lamp");
    const onEvent = () => { pending ??= setTimeout(() => refresh().catch(() => {}), document.hidden ? 10000 : pause); };
    // A whole service changes all the time; the page of one job needs a short delay.
    const pause = document.body.dataset.events.includes("/v1/") ? 300 : 1000;
    source.addEventListener("progress", onEvent);
    source.addEventListener("end", () => { onEvent(); source.close(); });
    source.addEventListener("open", () => lamp && lamp.removeAttribute("data-lost"));
    source.addEventListener("error", () => lamp && lamp.setAttribute("data-lost", ""));
    addEventListener("pagehide", () => source.close());
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-copy]");
    if (!button) return;
    const text = document.getElementById(button.dataset.copy).textContent;
    navigator.clipboard.writeText(text).then(() => {
      button.textContent = "Copied";
      setTimeout(() => { button.textContent = "Copy"; }, 1500);
    }, () => {});
  });

  // Command palette and keyboard shortcuts; a link has its key in `aria-keyshortcuts`.
  const palette = document.getElementById("palette"), single = document.getElementById("single-keys");
  let asked = 0;
  async function find() {
    const form = palette.querySelector("form"), number = ++asked;
    const answer = await fetch(`${form.action}?q=${encodeURIComponent(form.q.value)}`);
    const found = answer.ok && new DOMParser().parseFromString(await answer.text(), "text/html").getElementById("results");
    if (found && number === asked) palette.querySelector("ul").replaceChildren(...found.children);
  }
  const open = (id) => { document.getElementById(id).showModal(); if (id === "palette") find(); };
  function onKey(event) {
    const { key } = event, command = event.ctrlKey || event.metaKey;
    if (command && key === "k") {
      event.preventDefault();
      if (!palette.open) open("palette");
    } else if (palette.open && /^Arrow(Up|Down)$/.test(key)) {
      const stops = [palette.querySelector("[name=q]"), ...palette.querySelectorAll("a")];
      stops.at((stops.indexOf(document.activeElement) + (key === "ArrowDown" ? 1 : -1)) % stops.length).focus();
      event.preventDefault();
    } else if (single.checked && !command && !event.altKey && !event.target.closest("input, select, textarea, dialog")) {
      const target = document.querySelector(`[aria-keyshortcuts="${CSS.escape(key)}"]`);
      if (key === "?") open("keys");
      else target?.matches("input") ? target.focus() : target && target.click();
      if (target) event.preventDefault();
    }
  }
  if (palette) {
    single.checked = localStorage.getItem("single-keys") !== "off";
    single.addEventListener("change", () => localStorage.setItem("single-keys", single.checked ? "on" : "off"));
    palette.addEventListener("input", () => find().catch(() => {}));
    document.addEventListener("keydown", onKey);
    document.querySelector("[data-opens]").addEventListener("click", (event) => { event.preventDefault(); open("palette"); });
  }

  sayTimes(document);
  setInterval(() => sayTimes(document), 15000);
  document.addEventListener("htmx:after:swap", () => sayTimes(document));
  if (document.body.dataset.events) watch();
  const poll = Number(document.body.dataset.poll);
  if (poll) setInterval(() => { if (!document.hidden) refresh().catch(() => {}); }, 1000 * poll);
})();
