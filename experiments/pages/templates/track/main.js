// The page: what is chosen, and who draws what when it changes.

const data = unpacked(JSON.parse(document.getElementById("data").textContent));
const byId = (id) => document.getElementById(id);
const state = { run: null, recording: null, view: null, selected: -1, trackOf: null, window: [-Infinity, Infinity] };
const plot = byId("plan"), series = byId("series"), overlay = makeOverlay(plot, showTip);
const cursor = document.createElement("div");
cursor.className = "cursor";
const playback = makePlayback(showMoment, nextTime);

/** The track in the charts over time: the one chosen, else that with the largest error. */
const shownTrack = () => state.selected >= 0 ? state.selected : ranked()[0];

function ranked() {
  const rmse = (k) => state.recording.tracks[k].rmse ?? -1;
  return state.recording.tracks.map((_, k) => k).sort((a, b) => rmse(b) - rmse(a));
}

function option(value, text) {
  const made = document.createElement("option");
  made.value = value;
  made.textContent = text;
  return made;
}

function nextTime(time, direction) {
  const { recording } = state, track = recording.tracks[shownTrack()];
  if (!track) return time;
  let row = rowAt(recording, track, time + 1e-6) + direction;
  row = Math.min(Math.max(row, track.first), track.end - 1);
  return recording.columns.t[row];
}

function showMoment(time) {
  const { recording } = state;
  byId("clock").textContent = `${fixed(recording.start + time, 2)} s`;
  overlay.draw(time, state.selected, Number(byId("tail").value), state.window[0]);
  placeCursor(time);
  const number = shownTrack(), track = recording.tracks[number];
  const row = track ? rowAt(recording, track, time) : -1;
  const now = byId("now").querySelector("table"), pairs = row < 0 ? [["status", "no estimate yet"]] : numbersOf(recording, row);
  now.replaceChildren(...pairs.map(([name, text]) => {
    const line = document.createElement("tr");
    for (const words of [name, text]) line.appendChild(document.createElement("td")).textContent = words;
    return line;
  }));
}

function placeCursor(time) {
  const layout = series._fullLayout;
  if (!layout || !layout.xaxis) return;
  const { range, _length: length, _offset: offset } = layout.xaxis, at = state.recording.start + time;
  const x = offset + (at - range[0]) / (range[1] - range[0]) * length;
  cursor.style.cssText = `left:${x}px;top:${layout.margin.t}px;height:${layout.height - layout.margin.t - layout.margin.b}px;` +
    `display:${at >= range[0] && at <= range[1] ? "block" : "none"}`;
}

/** Limits the estimates that are drawn and played to a window of times. */
function setWindow(window) {
  state.window = window;
  playback.limit(Number.isFinite(window[0]) ? nextTime(window[0], 1) : 0, window[1]);
}

/** The moment of an event, which a zoom may have hidden. */
function goTo(time) {
  if (time < state.window[0] || time > state.window[1]) {
    setWindow([-Infinity, Infinity]);
    Plotly.relayout(series, { "xaxis.autorange": true });
  }
  playback.go(time);
}

/** Pairs of a name and a text beside the pointer; null hides them. */
function showTip(pairs, event) {
  const tip = byId("tip");
  tip.hidden = pairs === null;
  if (pairs === null) return;
  tip.textContent = pairs.map((pair) => pair.join(": ")).join("\n");
  const wide = tip.offsetWidth, x = event.clientX + 14;
  tip.style.left = `${x + wide > innerWidth ? Math.max(event.clientX - wide - 14, 4) : x}px`;
  tip.style.top = `${Math.min(event.clientY + 14, innerHeight - tip.offsetHeight - 4)}px`;
}

function drawPlan() {
  const { recording, selected, view } = state;
  const shown = selected >= 0 ? [selected] : recording.tracks.map((_, k) => k);
  const traces = planTraces(recording, view, shown, byId("colour").value, state.window, state.trackOf);
  Plotly.react(plot, traces, layoutOf(view.layout()), { ...CONFIG, scrollZoom: true }).then(() => showMoment(playback.now()));
}

function drawSeries() {
  const number = shownTrack(), { recording } = state;
  if (number === undefined) return;
  const { traces, layout } = seriesFigure(recording, number, state.window);
  if (Number.isFinite(state.window[0])) layout.xaxis.range = state.window.map((t) => t + recording.start);
  series.style.height = `${layout.height}px`;
  byId("series-lead").textContent = `Tag ${nameOf(recording.tracks[number])}` +
    (state.selected < 0 && recording.tracks.length > 1 ? ", the one with the largest error" : "") +
    ". A zoom here limits the estimates drawn above to the same times.";
  Plotly.react(series, traces, layout, CONFIG).then(() => {
    series.append(cursor);
    placeCursor(playback.now());
  });
}

function drawCharts() {
  const charts = chartsOf(state.recording), box = byId("charts");
  box.replaceChildren();
  byId("distributions").style.display = charts.length ? "" : "none";
  for (const { title, note, traces, layout } of charts) {
    const [figure, heading, place] = ["figure", "h3", "div"].map((kind) => document.createElement(kind));
    heading.textContent = title;
    place.className = "chart";
    figure.append(heading, place);
    if (note) figure.appendChild(document.createElement("figcaption")).textContent = note;
    box.append(figure);
    Plotly.newPlot(place, traces, layoutOf(layout), CONFIG);
  }
}

function drawAll() {
  drawPlan();
  drawSeries();
  drawCharts();
}

/** Shows the run of a tracker: of the same recording the same tag and moment, where it has them. */
function loadRun(number) {
  const before = state.recording, run = data.runs[number];
  const time = before && before.start + playback.now(), track = before && before.tracks[state.selected], { window } = state;
  state.run = run;
  byId("tracker").value = number;
  byId("summary").textContent = run.tracker;
  byId("figures").textContent = run.figures;
  byId("statements").replaceChildren(...run.statements.map((text) => {
    const item = document.createElement("li");
    item.textContent = text;
    return item;
  }));
  byId("recording").replaceChildren(...run.recordings.map((recording, k) => option(k, recording.name)));
  byId("recording-label").style.display = run.recordings.length > 1 ? "" : "none";
  const same = before ? run.recordings.findIndex((recording) => recording.name === before.name) : -1;
  byId("recording").value = Math.max(same, 0);
  loadRecording(Math.max(same, 0));
  if (same < 0) return;
  setWindow(window.map((t) => t + before.start - state.recording.start));
  select(track ? sameTrack(state.recording.tracks, track.tag, track.station) : -1);
  playback.go(time - state.recording.start);
}

const viewOf = (recording) => recording.angles ? polarOf(recording) : floorOf(recording);

/** The same recording by the other trackers, for the open circles; named below the plan. */
function otherRuns(recording) {
  const others = data.runs.flatMap((run, k) => run === state.run ? [] : run.recordings
    .filter((candidate) => candidate.name === recording.name && candidate.angles === recording.angles)
    .map((candidate) => ({ name: run.name, recording: candidate, view: viewOf(candidate), colour: lineColour(k) })));
  const words = others.flatMap(({ name, colour }, k) => {
    const made = document.createElement("b");
    made.style.color = colour;
    made.textContent = `○ ${name}`;
    return [k ? ", " : "", made];
  });
  byId("others").replaceChildren(...others.length ? ["At the same moment: ", ...words, "."] : []);
  return others;
}

function loadRecording(number) {
  const recording = state.run.recordings[number], view = viewOf(recording);
  Object.assign(state, { recording, view, selected: -1, trackOf: trackOfRows(recording), window: [-Infinity, Infinity] });
  byId("view-words").textContent = view.words;
  byId("colour").replaceChildren(...colourings(recording).map(([value, text]) => option(value, text)));
  const order = ranked(), last = order.length - 1;
  const words = new Map([[last, "best"], [last >> 1, "median"], [0, "worst"]]);
  byId("tag").replaceChildren(option(-1, recording.tracks.length > 1 ? `all ${recording.tracks.length}` : "all"), ...order.map((k, place) => {
    const { rmse } = recording.tracks[k], rank = rmse !== null && order.length > 2 ? words.get(place) : undefined;
    return option(k, nameOf(recording.tracks[k]) + (rmse === null ? "" : ` · ${withUnit(rmse, recording.axes[0].unit)}`) + (rank ? ` · ${rank}` : ""));
  }));
  const stations = new Set(recording.tracks.map((track) => track.station));
  if (order.length > 6 || stations.size > 1) state.selected = order[0];
  byId("tag").value = state.selected;
  overlay.load(recording, view, otherRuns(recording));
  listNow();
  byId("ticks").replaceChildren(...recording.events.map((event) => {
    const tick = document.createElement("i");
    tick.style.left = `${100 * event.t / (recording.end - recording.start)}%`;
    tick.title = `${event.what}, ${fixed(recording.start + event.t, 2)} s`;
    return tick;
  }));
  byId("drawn").textContent = drawnWords(recording);
  drawAll();
  playback.load(Math.max(recording.end - recording.start, 1e-3), firstEstimate(recording));
}

/** The time of the first estimate of the track in the charts over time, after its start has settled. */
function firstEstimate({ tracks, columns }) {
  const track = tracks[shownTrack()];
  if (!track) return 0;
  const size = (row) => spreadOf(columns, row), rows = [];
  for (let row = track.first; row < track.end; row++) if (Number.isFinite(columns.v0[row])) rows.push(row);
  const sizes = rows.map(size).filter(Number.isFinite).sort((a, b) => a - b);
  const settled = rows.find((row) => !(size(row) > 3 * sizes[sizes.length >> 1]));
  return settled === undefined ? 0 : columns.t[settled];
}

/** The numbers of the moment, and the events as links to their times. */
function listNow() {
  const { recording } = state, box = byId("now"), number = shownTrack();
  const heading = document.createElement("h3"), list = document.createElement("ul");
  heading.textContent = number === undefined ? "" : `tag ${nameOf(recording.tracks[number])}`;
  const events = recording.events.filter(({ track }) => state.selected < 0 || state.selected === track).slice(0, 12);
  list.replaceChildren(...events.map((event) => {
    const item = document.createElement("li");
    item.textContent = `${fixed(recording.start + event.t, 1)} s: ${event.what}` + (event.detail ? `, ${event.detail}` : "") +
      (state.selected < 0 && recording.tracks.length > 1 ? ` (${nameOf(recording.tracks[event.track])})` : "");
    item.addEventListener("click", () => goTo(event.t));
    return item;
  }));
  box.replaceChildren(heading, document.createElement("table"), list);
}

function drawnWords(recording) {
  const words = [];
  if (recording.drawn < recording.rows) {
    words.push(`Drawn: ${recording.drawn} of ${recording.rows} estimates, of each block of rows the first and the one with ` +
      "the largest error" + (recording.tracks.length < recording.trackCount
        ? `; of ${recording.tracks.length} of ${recording.trackCount} tracks, evenly over the ranks by error.` : "."));
  }
  if (recording.residuals.every > 1) words.push(`Residuals over time: one in ${recording.residuals.every}.`);
  if (recording.eventCount > recording.events.length) words.push(`${recording.events.length} of ${recording.eventCount} events are marked.`);
  if (words.length) words.push("All other charts and the metrics use every row.");
  const { recordings, recordingCount } = state.run;
  if (recordingCount > recordings.length) words.push(`${recordings.length} of ${recordingCount} recordings are on this page.`);
  return words.join(" ");
}

function select(number) {
  state.selected = number;
  byId("tag").value = number;
  listNow();
  drawPlan();
  drawSeries();
  showMoment(playback.now());
}

function fillMetrics() {
  const table = byId("metrics"), labels = ["recording", "tag", "station", "tracker"], metrics = metricsOfRuns();
  const columns = [...labels.map((key) => ({ key, title: key })), ...data.columns].filter(({ key }) => metrics.some((one) => one[key] !== undefined));
  byId("metrics-section").style.display = metrics.length ? "" : "none";
  const head = table.createTHead().insertRow();
  for (const { title } of columns) {
    const cell = document.createElement("th");
    cell.textContent = title;
    head.append(cell);
  }
  const body = table.createTBody();
  for (const one of metrics) {
    const line = body.insertRow();
    line.className = one.tag === undefined ? "whole" : "";
    for (const { key, title, factor, digits } of columns) {
      const cell = line.insertCell(), value = one[key], size = value * factor;
      cell.className = factor === undefined ? "name" : "";
      cell.dataset.label = title;
      cell.textContent = factor === undefined ? value ?? "" : value === undefined ? "–" : fixed(size, Math.abs(size) < 1e4 ? digits : 0);
    }
    line.addEventListener("click", () => chooseMetrics(one));
  }
}

/** The metrics of all trackers: recordings first, those of the same recording or track beside each other. */
function metricsOfRuns() {
  const all = data.runs.flatMap((run, number) => run.metrics.map((one) => ({ ...one, number, ...data.runs.length > 1 && { tracker: run.name } })));
  const key = (one) => JSON.stringify([one.recording, one.tag, one.station]), order = new Map();
  for (const one of [...all.filter((one) => one.tag === undefined), ...all]) if (!order.has(key(one))) order.set(key(one), order.size);
  return all.sort((a, b) => order.get(key(a)) - order.get(key(b)));
}

/** Shows the tracker, recording and tag of a line of the table. */
function chooseMetrics(one) {
  if (data.runs[one.number] !== state.run) loadRun(one.number);
  const { recordings } = state.run, number = recordings.findIndex((recording) => recording.name === one.recording);
  if (number < 0) return;
  if (recordings[number] !== state.recording) {
    byId("recording").value = number;
    loadRecording(number);
  }
  const track = sameTrack(state.recording.tracks, one.tag, one.station);
  if (track >= 0) select(track);
  byId("replay").scrollIntoView({ behavior: "smooth" });
}

/** Makes the page light and as wide as paper for a print, and afterwards as it was. */
function forPaper(begins) {
  const root = document.documentElement;
  if (begins === root.classList.contains("paper")) return;
  if (begins) state.theme = root.dataset.theme;
  root.classList.toggle("paper", begins);
  if (begins) root.dataset.theme = "light";
  else if (state.theme) root.dataset.theme = state.theme;
  else delete root.dataset.theme;
  drawAll();
  for (const chart of [plot, series]) {
    Plotly.relayout(chart, begins ? { width: chart.clientWidth, height: chart.clientHeight } : { width: null, height: null, autosize: true });
  }
  showMoment(playback.now());
}

function listen() {
  byId("tag").addEventListener("change", (event) => select(Number(event.target.value)));
  byId("colour").addEventListener("change", drawPlan);
  byId("tail").addEventListener("change", () => showMoment(playback.now()));
  byId("tracker").addEventListener("change", (event) => loadRun(Number(event.target.value)));
  byId("recording").addEventListener("change", (event) => loadRecording(Number(event.target.value)));
  document.documentElement.addEventListener("theme", drawAll);
  addEventListener("beforeprint", () => forPaper(true));
  addEventListener("afterprint", () => forPaper(false));
  plot.on("plotly_hover", ({ points, event }) => {
    const row = points[0].customdata;
    if (points[0].data.meta !== "estimates") return;
    showTip([["tag", nameOf(state.recording.tracks[state.trackOf[row]])], ...numbersOf(state.recording, row)], event);
  });
  plot.on("plotly_unhover", () => showTip(null));
  plot.on("plotly_click", ({ points }) => {
    if (points[0].data.meta === "estimates") playback.go(state.recording.columns.t[points[0].customdata]);
  });
  for (const event of ["plotly_relayouting", "plotly_relayout", "plotly_afterplot"]) {
    plot.on(event, () => showMoment(playback.now()));
  }
  series.on("plotly_click", ({ points }) => playback.go(points[0].x - state.recording.start));
  series.on("plotly_relayout", (change) => {
    if (!Object.keys(change).some((key) => key.startsWith("xaxis"))) return;
    const { start } = state.recording, range = series._fullLayout.xaxis.range;
    setWindow(change["xaxis.autorange"] ? [-Infinity, Infinity] : range.map((t) => t - start));
    drawSeries();
    drawPlan();
  });
  addEventListener("resize", () => showMoment(playback.now()));
}

byId("tracker").replaceChildren(...data.runs.map((run, k) => option(k, run.name)));
byId("tracker-label").style.display = data.runs.length > 1 ? "" : "none";
byId("command").textContent = data.command;
byId("command").closest("section").hidden = !data.command;
fillMetrics();
Plotly.newPlot(plot, [], {}, CONFIG);
Plotly.newPlot(series, [], {}, CONFIG);
listen();
loadRun(0);
