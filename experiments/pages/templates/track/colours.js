// Colours of lines and of rows.

const LINES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
const lineColour = (k) => LINES[k % LINES.length];

/** Whether the browser draws many points fast; without it there are fewer of them. */
const FAST = (() => {
  const canvas = document.createElement("canvas");
  return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
})();
const MARKS = FAST ? "scattergl" : "scatter";

/** What rows can be coloured by, for a recording. */
function colourings(recording) {
  const kinds = [];
  if (recording.tracks.some((track) => track.rmse !== null)) kinds.push(["error", "error"]);
  if (recording.nisBand) kinds.push(["nis", "NIS/dof"]);
  if (recording.sources.length) kinds.push(["source", recording.rig.anchors.length ? "anchor or station" : "station"]);
  kinds.push(["tag", "tag"], ["time", "time"]);
  return kinds;
}

/** The colour of each row as marker settings; `trackOf`: the number of the track of each row. */
function markerColours(recording, kind, rows, trackOf) {
  const { columns } = recording, unit = recording.axes[0].unit;
  if (kind === "source") return { color: rows.map((row) => lineColour(columns.source[row])) };
  if (kind === "tag") return { color: rows.map((row) => lineColour(trackOf[row])) };
  const [title, value] = {
    error: [`error (${unit})`, (row) => missOf(columns, row)],
    nis: ["NIS/dof", (row) => columns.nis[row] / columns.dof[row]],
    time: [recording.timeLabel, (row) => recording.start + columns.t[row]],
  }[kind];
  const values = rows.map(value), known = values.filter(Number.isFinite).sort((a, b) => a - b);
  const top = kind === "nis" ? 4 : known[Math.floor(0.98 * (known.length - 1))];
  const low = kind === "time" ? known[0] : 0;
  return {
    color: values.map((v) => Number.isFinite(v) ? v : low), cmin: low, cmax: top || 1, colorscale: "Viridis",
    colorbar: { title: { text: title, side: "right" }, thickness: 12, len: 0.85, outlinewidth: 0 },
  };
}
