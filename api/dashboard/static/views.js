// Saved views of a list: addresses with names, kept in this browser.
const KEY = `views:${location.pathname}`, form = document.getElementById("views");

function show(views = JSON.parse(localStorage.getItem(KEY) ?? "{}")) {
  document.getElementById("view-names").replaceChildren(...Object.entries(views).map(([textContent, query]) => {
    const ariaCurrent = query === location.search ? "true" : null;
    return Object.assign(document.createElement("a"), { href: location.pathname + query, textContent, ariaCurrent });
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
  show(others);
});
form.hidden = false;
document.addEventListener("htmx:after:swap", () => show());
show();
