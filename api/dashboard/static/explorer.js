// API explorer: Swagger UI of the service's OpenAPI document, in the colour scheme of the browser.
(() => {
  "use strict";
  document.documentElement.classList.toggle("dark-mode", matchMedia("(prefers-color-scheme: dark)").matches);
  SwaggerUIBundle({
    url: document.getElementById("explorer").dataset.document,
    dom_id: "#explorer",
    deepLinking: true,
    defaultModelsExpandDepth: 0,
    docExpansion: "list",
    validatorUrl: null, // no requests to other hosts
  });
})();
