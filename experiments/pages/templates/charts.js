// Draws the charts of a report, each from the data beside it.
const charts = [...document.querySelectorAll(".chart")].map((place) => [place, JSON.parse(place.firstChild.textContent)]);
const drawAll = () => charts.forEach(([place, chart]) => drawChart(place, chart));
drawAll();
onTheme(drawAll);
