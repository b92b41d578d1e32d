// The API explorer: Swagger UI over the service's own OpenAPI document, in the colours that the browser prefers.
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
    validatorUrl: null, // asks nobody elsewhere
  });
})();
