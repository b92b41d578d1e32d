// Saved views of a list: addresses with names, kept in this browser.
(() => {
  "use strict";
  const KEY = `views:${location.pathname}`;
  const form = document.getElementById("views"), nav = document.getElementById("view-names");

  function show() {
    const views = JSON.parse(localStorage.getItem(KEY) ?? "{}");
    nav.replaceChildren(...Object.entries(views).map(([name, query]) => {
      const link = Object.assign(document.createElement("a"), { href: location.pathname + query, textContent: name });
      if (query === location.search) link.ariaCurrent = "true";
      return link;
    }));
    return views;
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const { [form.view.value]: old, ...others } = show();
    // A view that is saved again where it leads is removed.
    if (old !== location.search) others[form.view.value] = location.search;
    localStorage.setItem(KEY, JSON.stringify(others));
    form.reset();
    show();
  });
  form.hidden = false;
  document.addEventListener("htmx:after:swap", show);
  show();
})();
