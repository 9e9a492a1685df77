// What moves over the floor plan, in SVG above it: tags, tails, ellipses, truth; drawn anew for each moment.

const LEVEL_95 = 5.991464547;  // quantile of chi squared with two degrees of freedom
const TAIL_S = 5, FADE_S = 3;  // a tag without an estimate for longer is not drawn

function element(kind, className, parent, attributes = {}) {
  const made = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", kind));
  made.setAttribute("class", className);
  set(made, attributes);
  return made;
}

const set = (made, attributes) => Object.entries(attributes).forEach(([name, value]) => made.setAttribute(name, value));

/** The overlay of the chart `plot`; `load(recording, view, others)`, `draw(time, selected)` shows a moment.
 *
 * `others`: of other trackers the same recording, its view and a colour; their estimates are open circles. */
function makeOverlay(plot) {
  const svg = element("svg", "overlay", plot), frame = element("g", "", svg, { "clip-path": "url(#plan-clip)" });
  const box = element("rect", "", element("clipPath", "", svg, { id: "plan-clip" }));
  let recording = null, view = null, parts = [];

  function load(next, nextView, others) {
    [recording, view] = [next, nextView];
    frame.replaceChildren();
    parts = recording.tracks.map((track, k) => {
      const group = element("g", "", frame), colour = lineColour(k), part = { group };
      for (const [name, kind] of [["tail", "polyline"], ["ellipse", "polygon"], ["miss", "line"], ["truth", "path"], ["tag", "circle"]]) {
        part[name] = element(kind, name, group, name === "tail" || name === "ellipse" ? { stroke: colour } : {});
      }
      part.ellipse.style.fill = colour;
      part.tag.style.cssText = `fill:${colour};color:${colour}`;
      part.tag.dataset.tag = nameOf(track);
      part.others = others.map((other) => {
        const circle = element("circle", "other", group, { r: 6, stroke: other.colour });
        return { circle, other, track: other.recording.tracks[trackOf(other.recording.tracks, track.tag, track.station)] };
      });
      return part;
    });
  }

  /** The row of a track at a time, s since the start of its recording; -1 without an estimate of late. */
  function present(of, track, time) {
    const { v0, t } = of.columns;
    const row = track ? rowAt(of, track, time) : -1;
    return row >= 0 && Number.isFinite(v0[row]) && time - t[row] <= FADE_S ? row : -1;
  }

  function draw(time, selected) {
    const { xaxis, yaxis } = plot._fullLayout, { columns, tracks } = recording, { t, v0, e0 } = columns;
    const px = (x) => xaxis._offset + (x - xaxis.range[0]) / (xaxis.range[1] - xaxis.range[0]) * xaxis._length;
    const py = (y) => yaxis._offset + yaxis._length * (1 - (y - yaxis.range[0]) / (yaxis.range[1] - yaxis.range[0]));
    const corners = (places) => places.map(([x, y]) => `${px(x).toFixed(1)},${py(y).toFixed(1)}`).join(" ");
    set(box, { x: xaxis._offset, y: yaxis._offset, width: xaxis._length, height: yaxis._length });
    tracks.forEach((track, k) => {
      const part = parts[k], row = present(recording, track, time);
      part.group.style.display = row >= 0 && (selected < 0 || selected === k) ? "" : "none";
      if (part.group.style.display) return;
      const [x, y] = view.at(row), points = [];
      set(part.tag, { cx: px(x), cy: py(y), r: selected === k ? 7 : 5.5 });
      part.tag.classList.toggle("lost", recording.statuses[columns.status[row]] === "lost");
      for (let at = row; at >= track.first && time - t[at] <= TAIL_S; at--) {
        if (Number.isFinite(v0[at])) points.push(view.at(at));
      }
      part.tail.setAttribute("points", corners(points));
      part.ellipse.setAttribute("points", corners(view.region(row)));
      for (const { circle, other, track: same } of part.others) {
        const at = present(other.recording, same, time + recording.start - other.recording.start);
        circle.style.display = at >= 0 ? "" : "none";
        if (at < 0) continue;
        const [u, v] = other.view.at(at).map((value, axis) => value + other.recording.origin[axis] - recording.origin[axis]);
        set(circle, { cx: px(u), cy: py(v) });
      }
      part.truth.style.display = part.miss.style.display = Number.isFinite(e0[row]) ? "" : "none";
      if (!Number.isFinite(e0[row])) return;
      const [u, v] = view.truth(row), [begin, end] = view.miss(row);
      set(part.truth, { d: `M${px(u) - 6},${py(v)}h12M${px(u)},${py(v) - 6}v12` });
      set(part.miss, { x1: px(begin[0]), y1: py(begin[1]), x2: px(end[0]), y2: py(end[1]) });
    });
  }

  return { load, draw };
}

/** Corners of the 95 % ellipse of a row, m; none without a covariance. */
function ellipse({ v0, v1, s0, s1, cov }, row) {
  const a = s0[row] ** 2, b = cov[row], c = s1[row] ** 2;
  if (!(a > 0 && a * c - b * b > 0)) return [];
  // Cholesky factor of the covariance: it takes the circle to the ellipse.
  const l11 = Math.sqrt(a), l21 = b / l11, l22 = Math.sqrt(c - l21 * l21);
  return Array.from({ length: 40 }, (_, k) => {
    const [u, v] = [Math.cos, Math.sin].map((of) => Math.sqrt(LEVEL_95) * of(k * Math.PI / 20));
    return [v0[row] + l11 * u, v1[row] + l21 * u + l22 * v];
  });
}
