// Draws the figures of the page with plotly.js and moves their sliders. The page holds all data.
"use strict";

const KINDS = {
  f4: Float32Array, f8: Float64Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array,
};
const CONFIG = { responsive: true, displayModeBar: false }; // the bar would cover the legend
const PAPER_WIDTH = 660; // pixels that fit between the margins of A4 and of Letter

function numbers(spec) {
  const bytes = Uint8Array.from(atob(spec.bdata), (character) => character.charCodeAt(0));
  return new KINDS[spec.dtype](bytes.buffer);
}

// A heat map of counts: colors follow the logarithm, cells without visits stay blank.
function colored(trace) {
  const { meta, ...rest } = trace;
  if (meta !== "counts") return rest;
  const counts = numbers(trace.z);
  const [rows, columns] = trace.z.shape.split(", ").map(Number);
  const z = [], text = [];
  for (let row = 0; row < rows; row += 1) {
    const line = Array.from(counts.subarray(row * columns, (row + 1) * columns));
    z.push(line.map((count) => (count > 0 ? Math.log10(count) : null)));
    text.push(line.map(String));
  }
  const top = Math.max(1, Math.ceil(Math.log10(counts.reduce((a, b) => Math.max(a, b), 1))));
  const powers = Array.from({ length: top + 1 }, (_, power) => power);
  const colorbar = { ...rest.colorbar, tickvals: powers, ticktext: powers.map((power) => String(10 ** power)) };
  return { ...rest, z, text, zmin: 0, zmax: top, colorbar, hovertemplate: "%{text}<extra></extra>" };
}

function draw(figure) {
  const document_ = JSON.parse(figure.querySelector("script").textContent);
  const plot = figure.querySelector(".plot");
  const slider = figure.querySelector("input");
  const show = (place) => {
    const frame = document_.frames[place];
    // The layout carries what the reader did to it, such as a zoom.
    return Plotly.react(plot, frame.traces.map(colored), { ...document_.layout, uirevision: "kept" }, CONFIG);
  };
  if (slider) {
    const output = figure.querySelector("output");
    slider.addEventListener("input", () => {
      const place = Number(slider.value);
      output.textContent = document_.frames[place].label;
      show(place);
    });
  }
  return show(slider ? Number(slider.value) : 0).then(() => figure.classList.add("drawn"));
}

const figures = Array.from(document.querySelectorAll("figure.interactive"));
Promise.all(figures.map(draw)).then(() => document.documentElement.classList.add("ready"));

const folded = [];
addEventListener("beforeprint", () => {
  for (const details of document.querySelectorAll("details:not([open]):not(.long)")) {
    details.open = true;
    folded.push(details);
  }
  for (const figure of figures) Plotly.relayout(figure.querySelector(".plot"), { width: PAPER_WIDTH });
});
addEventListener("afterprint", () => {
  for (const details of folded.splice(0)) details.open = false;
  for (const figure of figures) {
    const plot = figure.querySelector(".plot");
    Plotly.relayout(plot, { width: null, autosize: true }).then(() => Plotly.Plots.resize(plot));
  }
});
