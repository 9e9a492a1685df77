// Charts of plotly.js in the colours of the page.

/** The value of a colour of the style sheet in the theme of the moment. */
function themed(name) {
  const probe = document.body.appendChild(document.createElement("i"));
  probe.style.color = `var(--${name})`;
  const colour = getComputedStyle(probe).color;
  probe.remove();
  return colour;
}

/** A layout in the colours of the page. */
function layoutOf(settings) {
  const [ink, soft, line, paper] = ["ink", "soft", "line", "paper"].map(themed);
  const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, tickcolor: line, automargin: true };
  const layout = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", dragmode: "zoom",
    font: { family: "Helvetica Neue, Arial, Liberation Sans, sans-serif", size: 12, color: soft },
    margin: { l: 56, r: 12, t: 34, b: 44 }, hoverlabel: { bgcolor: paper, bordercolor: line, font: { color: ink } },
    legend: { orientation: "h", x: 0, xanchor: "left", y: 1.01, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)" },
    // Upright, since the legend is above the chart.
    modebar: { orientation: "v", bgcolor: "rgba(0,0,0,0)", color: soft, activecolor: ink },
    ...settings,
  };
  for (const name of Object.keys(layout).filter((name) => /^[xy]axis\d*$/.test(name))) layout[name] = { ...axis, ...layout[name] };
  return layout;
}

/** A chart that Python describes, with black and blue in the colours of the page. */
function drawChart(place, { data, layout, height }) {
  const theme = { "#000000": themed("ink"), "#1d2733": themed("ink"), "#0072b2": themed("blue") };
  const coloured = (part) => part && { ...part, color: theme[part.color] ?? part.color };
  const traces = data.map((trace) => ({ ...trace, line: coloured(trace.line), ...trace.marker && { marker: coloured(trace.marker) } }));
  const longest = Math.max(...data.map(({ name, showlegend }) => showlegend ? name.length : 0));
  const abreast = Math.max(1, Math.floor((place.clientWidth - 60) / (45 + 6.5 * longest)));
  const above = 20 * Math.ceil(data.filter((trace) => trace.showlegend).length / abreast);
  place.style.height = `${Math.max(240, Math.min(place.clientWidth * height, 430)) + above}px`;
  Plotly.react(place, traces, layoutOf({ ...layout, margin: { l: 50, r: 12, t: 16 + above, b: 44 } }), CONFIG);
}

// Named one by one: by default there is a button that uploads the chart to a server.
const CONFIG = {
  responsive: true, displaylogo: false, showSendToCloud: false, plotlyServerURL: "",
  modeBarButtons: [["zoom2d", "pan2d", "resetScale2d", "toImage"]],
};

const onTheme = (draw) => matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
