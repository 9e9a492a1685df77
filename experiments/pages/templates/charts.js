// Draws the charts of the page that have data with plotly.js; the images stay, for paper.
(() => {
  "use strict";

  /** The data within an image of the page; undefined without. */
  function dataOf(image) {
    const bytes = Uint8Array.from(atob(image.src.split(",")[1]), (c) => c.charCodeAt(0));
    const metadata = new TextDecoder().decode(bytes).match(/<metadata id="chart">(.*?)<\/metadata>/s);
    return metadata ? JSON.parse(metadata[1]) : undefined;
  }

  function draw([place, chart]) {
    const { title, ...layout } = chart.layout, rows = place.clientWidth < 420 ? 2 : 3;
    const above = layout.showlegend ? legendHeight(chart.data, rows) : 0;
    Plotly.react(place, inTheme(chart.data), layoutOf({ ...layout, margin: { l: 44, r: 10, t: 14 + above, b: 40 } }), CONFIG);
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
