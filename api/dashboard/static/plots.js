// Bar charts by uPlot. They replace the page's SVG with the same numbers, and show the value under the pointer.
(() => {
  "use strict";
  const made = new Map();

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  // Canvas does not support light-dark(): the browser resolves it.
  function resolved(name) {
    const probe = document.createElement("i");
    probe.className = `probe-${name}`;
    document.body.append(probe);
    const value = getComputedStyle(probe).color;
    probe.remove();
    return value;
  }

  const clock = (seconds) => new Date(1000 * seconds).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });

  function options(figure, data, width) {
    const { x, y, unit } = data;
    const ink = resolved("ink"), line = resolved("line"), accent = resolved("accent");
    const font = `12px ${colour("--sans")}`;
    const axis = { stroke: ink, font, grid: { stroke: line, width: 1 }, ticks: { show: false } };
    return {
      width, height: Number(figure.dataset.height ?? 180), padding: [8, 18, 0, 0],
      cursor: { points: { size: 7 }, drag: { x: false, y: false } },
      legend: { live: true },
      scales: { x: { time: true }, y: { range: (_, low, high) => [0, Math.max(high, 1) * 1.08] } },
      axes: [
        { ...axis, size: 30, gap: 8, space: 90, grid: { show: false }, values: (_, ticks) => ticks.map((t) => clock(t)) },
        { ...axis, size: 44, gap: 8, space: 36 },
      ],
      series: [
        { label: x, value: (_, v) => (v === null || v === undefined ? "–" : clock(v)) },
        {
          label: y, stroke: accent, fill: accent, width: 0, points: { show: false },
          paths: uPlot.paths.bars({ size: [0.82, 40], radius: 0.15 }),
          value: (_, v) => (v === null || v === undefined ? "–" : `${Number(v.toPrecision(4))} ${unit}`.trim()),
        },
      ],
    };
  }

  function plot(figure) {
    const data = JSON.parse(figure.dataset.plot);
    const width = Math.floor(figure.clientWidth);
    if (!width) return;
    const text = figure.dataset.plot + width + matchMedia("(prefers-color-scheme: dark)").matches;
    if (made.get(figure)?.text === text) return;
    made.get(figure)?.chart.destroy();
    const fallback = figure.querySelector("svg");
    if (fallback) fallback.setAttribute("hidden", "");
    const chart = new uPlot(options(figure, data, width), [data.xs, data.ys], figure);
    chart.root.setAttribute("aria-hidden", "true");
    made.set(figure, { chart, text });
  }

  function all() {
    for (const figure of made.keys()) if (!figure.isConnected) made.delete(figure);
    document.querySelectorAll("[data-plot]").forEach(plot);
  }

  all();
  addEventListener("resize", all);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", all);
  document.addEventListener("graspd:swapped", all);
  document.addEventListener("htmx:after:swap", all);
})();
