// API explorer: Swagger UI of the service's OpenAPI document, in the colour scheme of the browser.
(() => {
  "use strict";
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = () => document.documentElement.classList.toggle("dark-mode", dark.matches);
  dark.addEventListener("change", paint);
  paint();
  SwaggerUIBundle({
    url: document.getElementById("explorer").dataset.document,
    dom_id: "#explorer",
    deepLinking: true,
    defaultModelsExpandDepth: 0,
    docExpansion: "list",
    validatorUrl: null, // no requests to other hosts
  });
})();
