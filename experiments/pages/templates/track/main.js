// The page: what is chosen, and who draws what when it changes.

const byId = (id) => document.getElementById(id), data = unpacked(byId("data").textContent);
const state = { run: null, recording: null, view: null, selected: -1 };
const plot = byId("plan"), series = byId("series"), overlay = makeOverlay(plot);
const cursor = Object.assign(document.createElement("div"), { className: "cursor" });
const playback = makePlayback(showMoment, nextTime);

/** An element with a text, and more properties. */
const made = (kind, textContent, more = {}) => Object.assign(document.createElement(kind), { textContent, ...more });

/** The numbers of the tracks from the largest RMSE to the smallest. */
const ranked = () => [...state.recording.tracks.keys()].sort((a, b) => rmseOf(b) - rmseOf(a));
const rmseOf = (k) => state.recording.tracks[k].rmse ?? -1;

/** The track in the charts over time: the one chosen, else the one with the largest error. */
const shownTrack = () => state.selected >= 0 ? state.selected : ranked()[0];

function nextTime(time, direction) {
  const { recording } = state, track = recording.tracks[shownTrack()];
  if (!track) return time;
  const row = rowAt(recording, track, time + 1e-6) + direction;
  return recording.columns.t[Math.min(Math.max(row, track.first), track.end - 1)];
}

function showMoment(time) {
  const { recording, selected } = state, track = recording.tracks[shownTrack()], row = track ? rowAt(recording, track, time) : -1;
  byId("clock").textContent = `${fixed(recording.start + time, 2)} s`;
  overlay.draw(time, selected);
  placeCursor(time);
  const pairs = row < 0 ? [["status", "no estimate yet"]] : numbersOf(recording, row);
  byId("now").querySelector("table").replaceChildren(...pairs.map((pair) => {
    const line = document.createElement("tr");
    line.append(...pair.map((text) => made("td", text)));
    return line;
  }));
}

function placeCursor(time) {
  const { xaxis, margin, height } = series._fullLayout ?? {};
  if (!xaxis) return;
  const at = state.recording.start + time, [from, to] = xaxis.range;
  cursor.style.cssText = `left:${xaxis._offset + (at - from) / (to - from) * xaxis._length}px;top:${margin.t}px;` +
    `height:${height - margin.t - margin.b}px;display:${at >= from && at <= to ? "block" : "none"}`;
}

function drawPlan() {
  const { recording, selected, view } = state, shown = selected >= 0 ? [selected] : [...recording.tracks.keys()];
  const traces = planTraces(recording, view, shown, byId("colour").value);
  Plotly.react(plot, traces, layoutOf(view.layout()), { ...CONFIG, scrollZoom: true }).then(() => showMoment(playback.now()));
}

function drawSeries() {
  const number = shownTrack(), { recording } = state;
  if (number === undefined) return;
  const { traces, layout } = seriesFigure(recording, number);
  series.style.height = `${layout.height}px`;
  const largest = state.selected < 0 && recording.tracks.length > 1 ? ", the one with the largest error" : "";
  byId("series-lead").textContent = `Tag ${nameOf(recording.tracks[number])}${largest}.`;
  Plotly.react(series, traces, layout, CONFIG).then(() => {
    series.append(cursor);
    placeCursor(playback.now());
  });
}

function drawCharts() {
  byId("distributions").hidden = !state.recording.charts.length;
  byId("charts").replaceChildren();
  for (const chart of state.recording.charts) {
    const figure = byId("charts").appendChild(document.createElement("figure")), place = made("div", "", { className: "chart" });
    figure.append(made("h3", chart.title, { className: "chart-title" }), place, made("figcaption", chart.note));
    drawChart(place, chart);
  }
}

function drawAll() {
  drawPlan();
  drawSeries();
  drawCharts();
}

const choose = (id, options) => byId(id).replaceChildren(...options.map(([value, text]) => made("option", text, { value })));
const hideLone = (id) => { byId(`${id}-label`).hidden = byId(id).length < 2; };

/** Shows the run of a tracker: of the same recording the same tag and moment, where it has them. */
function loadRun(number) {
  const { recording: before, selected } = state, run = data.runs[number], time = before && before.start + playback.now();
  const track = before?.tracks[selected];
  state.run = run;
  byId("tracker").value = number;
  byId("summary").textContent = run.tracker;
  byId("statements").replaceChildren(...run.statements.map((text) => made("li", text)));
  choose("recording", run.recordings.map((recording, k) => [k, recording.name]));
  hideLone("recording");
  const same = run.recordings.findIndex((recording) => recording.name === before?.name);
  loadRecording(Math.max(same, 0));
  if (same < 0) return;
  select(track ? trackOf(state.recording.tracks, track.tag, track.station) : -1);
  playback.go(time - state.recording.start);
}

const viewOf = (recording) => recording.angles ? polarOf(recording) : floorOf(recording);

/** The same recording by the other trackers, for the open circles; named below the plan. */
function otherRuns(recording) {
  const others = data.runs.flatMap((run, k) => run === state.run ? [] : run.recordings
    .filter((one) => one.name === recording.name && one.angles === recording.angles)
    .map((one) => ({ name: run.name, recording: one, view: viewOf(one), colour: lineColour(k) })));
  const words = others.flatMap(({ name, colour }) => [made("b", `○ ${name}`, { style: `color:${colour}` }), " "]);
  byId("others").replaceChildren(...others.length ? ["At the same moment: ", ...words] : []);
  return others;
}

function loadRecording(number) {
  const recording = state.run.recordings[number], view = viewOf(recording), { tracks, columns, events } = recording;
  recording.trackOf = new Uint16Array(columns.t.length);
  tracks.forEach((track, k) => recording.trackOf.fill(k, track.first, track.end));
  Object.assign(state, { recording, view, selected: -1 });
  byId("recording").value = number;
  byId("view-words").textContent = view.words;
  choose("colour", Object.keys(colourings(recording)).map((name) => [name, name]));
  const order = ranked(), last = order.length - 1, words = new Map([[last, " · best"], [last >> 1, " · median"], [0, " · worst"]]);
  choose("tag", [[-1, tracks.length > 1 ? `all ${tracks.length}` : "all"], ...order.map((k, place) => {
    const { rmse } = tracks[k], rank = rmse !== null && last > 1 && words.get(place) || "";
    return [k, nameOf(tracks[k]) + (rmse === null ? "" : ` · ${withUnit(rmse, recording.axes[0].unit)}`) + rank];
  })]);
  if (order.length > 6 || new Set(tracks.map((track) => track.station)).size > 1) state.selected = order[0];
  byId("tag").value = state.selected;
  overlay.load(recording, view, otherRuns(recording));
  listNow();
  byId("drawn").textContent = drawnWords(recording);
  drawAll();
  playback.load(Math.max(recording.end - recording.start, 1e-3), 0);
}

/** The name of the track of the moment, and the events as links to their times. */
function listNow() {
  const { recording, selected } = state, box = byId("now"), track = recording.tracks[shownTrack()];
  box.querySelector("h3").textContent = track ? `tag ${nameOf(track)}` : "";
  const events = recording.events.filter((event) => selected < 0 || selected === event.track).slice(0, 12);
  box.querySelector("ul").replaceChildren(...events.map((event) => {
    const of = selected < 0 && recording.tracks.length > 1 ? ` (${nameOf(recording.tracks[event.track])})` : "";
    return made("li", `${fixed(recording.start + event.t, 1)} s: ${event.what}${of}`, { onclick: () => playback.go(event.t) });
  }));
}

function drawnWords(recording) {
  const { recordings, recordingCount } = state.run, all = [
    [recording.drawn, recording.rows, "estimates, the first and the one with the largest error of each block"],
    [recording.tracks.length, recording.trackCount, "tracks, evenly over the ranks by error"],
    [1, recording.residuals.every, "residuals over time"],
    [recording.events.length, recording.eventCount, "events"],
    [recordings.length, recordingCount, "recordings"],
  ].filter(([shown, total]) => shown < total).map(([shown, total, what]) => `${shown} of ${total} ${what}`);
  return all.length ? `Drawn: ${all.join("; ")}. All other charts and the metrics use every row.` : "";
}

function select(number) {
  state.selected = number;
  byId("tag").value = number;
  listNow();
  drawPlan();
  drawSeries();
  showMoment(playback.now());
}

function listen() {
  const changes = { tag: select, colour: drawPlan, tracker: loadRun, recording: loadRecording };
  for (const [id, change] of Object.entries(changes)) byId(id).addEventListener("change", (event) => change(Number(event.target.value)));
  onTheme(drawAll);
  const isEstimate = ({ data: { meta } }) => meta === "estimates";
  plot.on("plotly_click", ({ points: [point] }) => isEstimate(point) && playback.go(state.recording.columns.t[point.customdata]));
  for (const event of ["plotly_relayouting", "plotly_relayout", "plotly_afterplot"]) plot.on(event, () => showMoment(playback.now()));
  series.on("plotly_click", ({ points: [point] }) => playback.go(point.x - state.recording.start));
  series.on("plotly_relayout", () => placeCursor(playback.now()));
  addEventListener("resize", () => showMoment(playback.now()));
}

choose("tracker", data.runs.map((run, k) => [k, run.name]));
hideLone("tracker");
Plotly.newPlot(plot, [], {}, CONFIG);
Plotly.newPlot(series, [], {}, CONFIG);
listen();
loadRun(0);
