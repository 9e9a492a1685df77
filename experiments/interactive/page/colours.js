// Colours of the page's theme for charts, and colours of rows.

const LINES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
const lineColour = (k) => LINES[k % LINES.length];

/** The value of a colour of the style sheet in the theme of the moment. */
function themed(name) {
  const probe = document.createElement("i");
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}

/** A layout in the colours of the page. */
function layoutOf(own) {
  const [ink, soft, line, paper] = ["ink", "soft", "line", "paper"].map(themed);
  const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, tickcolor: line, automargin: true };
  const layout = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", colorway: LINES, dragmode: "zoom",
    font: { family: "Helvetica Neue, Arial, Liberation Sans, sans-serif", size: 12, color: soft },
    margin: { l: 56, r: 12, t: 34, b: 44 }, hoverlabel: { bgcolor: paper, bordercolor: line, font: { color: ink } },
    legend: { orientation: "h", x: 0, xanchor: "left", y: 1.01, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)" },
    ...own,
  };
  for (const name of Object.keys(layout)) {
    if (/^[xy]axis\d*$/.test(name)) layout[name] = { ...axis, ...layout[name] };
  }
  return layout;
}

const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] };

/** Whether the browser draws many points fast; without it there are fewer of them. */
const FAST = (() => {
  const canvas = document.createElement("canvas");
  return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
})();
const MARKS = FAST ? "scattergl" : "scatter";

/** What rows can be coloured by, for a recording. */
function colourings(recording) {
  const found = [];
  if (recording.tracks.some((track) => track.rmse !== null)) found.push(["error", "error"]);
  if (recording.nisBand) found.push(["nis", "NIS/dof"]);
  if (recording.sources.length) found.push(["source", recording.rig.anchors.length ? "anchor or station" : "station"]);
  found.push(["tag", "tag"], ["time", "time"]);
  return found;
}

/** The colour of each row as marker settings; `trackOf`: the number of the track of each row. */
function markerColours(recording, kind, rows, trackOf) {
  const { columns } = recording, unit = recording.axes[0].unit;
  if (kind === "source") return { color: rows.map((row) => lineColour(columns.source[row])) };
  if (kind === "tag") return { color: rows.map((row) => lineColour(trackOf[row])) };
  const [title, value] = {
    error: [`error (${unit})`, (row) => missOf(columns, row)],
    nis: ["NIS/dof", (row) => columns.nis[row] / columns.dof[row]],
    time: ["time (s)", (row) => recording.start + columns.t[row]],
  }[kind];
  const values = rows.map(value), known = values.filter(Number.isFinite).sort((a, b) => a - b);
  const top = kind === "nis" ? 4 : known[Math.floor(0.98 * (known.length - 1))];
  const low = kind === "time" ? known[0] : 0;
  return {
    color: values.map((v) => Number.isFinite(v) ? v : low), cmin: low, cmax: top || 1, colorscale: "Viridis",
    colorbar: { title: { text: title, side: "right" }, thickness: 12, len: 0.85, outlinewidth: 0 },
  };
}
