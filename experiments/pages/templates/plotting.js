// Charts of plotly.js in the colours of the page.

/** The value of a colour of the style sheet in the theme of the moment. */
function themed(name) {
  const probe = document.createElement("i");
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
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
  for (const name of Object.keys(layout)) {
    if (/^[xy]axis\d*$/.test(name)) layout[name] = { ...axis, ...layout[name] };
  }
  return layout;
}

const INK = /rgba\((29,39,51|0,0,0),/, BLUE = /rgba\(0,114,178,1\)/;

/** The traces with black and blue in the colours of the page. */
function inTheme(traces) {
  const [ink, blue] = ["ink", "blue"].map(themed);
  const swap = (colour) => !colour ? colour : INK.test(colour) ? ink : BLUE.test(colour) ? blue : colour;
  return traces.map((trace) => ({
    ...trace, line: { ...trace.line, color: swap(trace.line.color) },
    ...(trace.marker ? { marker: { ...trace.marker, color: swap(trace.marker.color) } } : {}),
  }));
}

/** Pixels of a legend above a chart with so many names abreast. */
const legendHeight = (traces, abreast) => 20 * Math.ceil(traces.filter((trace) => trace.showlegend).length / abreast);

// Named one by one: by default there is a button that uploads the chart to a server.
const CONFIG = {
  responsive: true, displaylogo: false, showSendToCloud: false, plotlyServerURL: "",
  modeBarButtons: [["zoom2d", "pan2d", "resetScale2d", "toImage"]],
};

// A phone has no room for the toolbar, paper none for plotly's hints.
const rules = document.createElement("style");
rules.textContent = "@media (max-width: 599px) { .modebar-container { display: none } } " +
  "@media print { .modebar-container, .plotly-notifier { display: none !important } }";
document.head.append(rules);
