// Draws the charts of the page that have data with plotly.js; the images stay, for paper.
(() => {
  "use strict";
  const INK = /rgba\((29,39,51|0,0,0),/, BLUE = /rgba\(0,114,178,1\)/;

  /** The data within an image of the page; undefined without. */
  function dataOf(image) {
    const bytes = Uint8Array.from(atob(image.src.split(",")[1]), (c) => c.charCodeAt(0));
    const found = new TextDecoder().decode(bytes).match(/<metadata id="chart">(.*?)<\/metadata>/s);
    return found ? JSON.parse(found[1]) : undefined;
  }

  /** The traces with black and blue in the colours of the page. */
  function inTheme(traces) {
    const [ink, blue] = ["ink", "blue"].map(themed);
    const swap = (colour) => !colour ? colour : INK.test(colour) ? ink : BLUE.test(colour) ? blue : colour;
    return traces.map((trace) => ({
      ...trace, line: { ...trace.line, color: swap(trace.line.color) },
      ...(trace.marker ? { marker: { ...trace.marker, color: swap(trace.marker.color) } } : {}),
    }));
  }

  function draw([place, chart]) {
    const { title, ...layout } = chart.layout, legends = chart.data.filter((trace) => trace.showlegend).length;
    const narrow = place.clientWidth < 420;
    Plotly.react(place, inTheme(chart.data), layoutOf({
      ...layout, margin: { l: 44, r: 10, t: 14 + (layout.showlegend ? 20 * Math.ceil(legends / (narrow ? 2 : 3)) : 0), b: 40 },
    }), CONFIG);
  }

  const places = [];
  for (const image of document.querySelectorAll('figure img[src^="data:image/svg+xml;base64,"]')) {
    const chart = dataOf(image);
    if (!chart) continue;
    const place = document.createElement("div"), heading = document.createElement("h3");
    heading.className = "chart-title";
    if (chart.layout.title) heading.innerHTML = chart.layout.title;  // escaped where it was made
    else heading.textContent = image.alt;
    place.className = "chart";
    place.style.aspectRatio = String(1 / chart.height);
    image.classList.add("still");
    image.after(heading, place);
    places.push([place, chart]);
  }
  places.forEach(draw);
  document.documentElement.addEventListener("theme", () => places.forEach(draw));
})();
