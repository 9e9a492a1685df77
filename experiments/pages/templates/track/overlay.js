// What moves over the floor plan, in SVG above it: tags, tails, ellipses, truth; drawn anew for each moment.

const SVG = "http://www.w3.org/2000/svg";
const LEVEL_95 = 5.991464547;  // quantile of chi squared with two degrees of freedom
const FADE_S = 3;  // a tag without an estimate for longer is not drawn

function element(kind, className, parent) {
  const made = document.createElementNS(SVG, kind);
  made.setAttribute("class", className);
  parent.append(made);
  return made;
}

/** The overlay of the chart `plot`; `load(recording, view, others)`, `draw(time, selected, tail, from)` shows a moment.
 *
 * `others`: of other trackers the same recording, its view and a colour; their estimates are open circles, whose
 * numbers `tell(pairs, event)` shows while the pointer is on them. `from`: no estimate before it is drawn. */
function makeOverlay(plot, tell) {
  const svg = element("svg", "overlay", plot), frame = element("g", "", svg);
  const clip = element("clipPath", "", svg), box = element("rect", "", clip);
  clip.id = "plan-clip";
  frame.setAttribute("clip-path", "url(#plan-clip)");
  let recording = null, view = null, others = [], parts = [];

  function load(next, nextView, nextOthers) {
    [recording, view, others] = [next, nextView, nextOthers];
    frame.replaceChildren();
    parts = recording.tracks.map((track, k) => {
      const group = element("g", "", frame), colour = lineColour(k);
      const part = { group };
      for (const [name, kind] of [["tail", "polyline"], ["ellipse", "polygon"], ["miss", "line"], ["truth", "path"],
                                  ["tag", "circle"]]) {
        part[name] = element(kind, name, group);
      }
      part.tail.style.stroke = colour;
      part.ellipse.style.cssText = `stroke:${colour};fill:${colour}`;
      part.tag.style.cssText = `fill:${colour};color:${colour}`;
      part.tag.dataset.tag = nameOf(track);
      part.others = others.map((other) => {
        const circle = element("circle", "other", group), same = sameTrack(other.recording.tracks, track.tag, track.station);
        circle.style.stroke = other.colour;
        circle.dataset.tag = nameOf(track);
        circle.setAttribute("r", 6);
        circle.addEventListener("pointermove", (event) => tell(
          [["tracker", other.name], ["tag", nameOf(track)], ...numbersOf(other.recording, Number(circle.dataset.row))], event));
        circle.addEventListener("pointerleave", () => tell(null));
        return { circle, other, track: other.recording.tracks[same] };
      });
      return part;
    });
  }

  function draw(time, selected, tail, from) {
    const { xaxis, yaxis } = plot._fullLayout, { columns, tracks } = recording;
    const scale = (axis, flip) => {
      const [from, to] = axis.range, factor = axis._length / (to - from);
      return flip ? (v) => axis._offset + axis._length - (v - from) * factor : (v) => axis._offset + (v - from) * factor;
    };
    const px = scale(xaxis, false), py = scale(yaxis, true);
    const corners = (places) => places.map(([x, y]) => `${px(x).toFixed(1)},${py(y).toFixed(1)}`).join(" ");
    for (const [name, value] of [["x", xaxis._offset], ["y", yaxis._offset], ["width", xaxis._length], ["height", yaxis._length]]) {
      box.setAttribute(name, value);
    }
    tracks.forEach((track, k) => {
      const part = parts[k], row = rowAt(recording, track, time), { v0, e0, t } = columns;
      const there = row >= 0 && Number.isFinite(v0[row]) && time - t[row] <= FADE_S && t[row] >= from;
      part.group.style.display = there && (selected < 0 || selected === k) ? "" : "none";
      if (part.group.style.display) return;
      const [x, y] = view.at(row);
      part.tag.setAttribute("cx", px(x));
      part.tag.setAttribute("cy", py(y));
      part.tag.setAttribute("r", selected === k ? 7 : 5.5);
      part.tag.classList.toggle("selected", selected === k);
      part.tag.classList.toggle("lost", recording.statuses[columns.status[row]] === "lost");
      part.tag.dataset.row = row;
      const points = [];
      for (let at = row; at >= track.first && time - t[at] <= tail && t[at] >= from; at--) {
        if (Number.isFinite(v0[at])) points.push(view.at(at));
      }
      part.tail.setAttribute("points", corners(points));
      part.ellipse.setAttribute("points", corners(view.region(row)));
      for (const { circle, other, track: same } of part.others) {
        const counterpart = other.recording, at = same ? rowAt(counterpart, same, time + recording.start - counterpart.start) : -1;
        const seen = at >= 0 && Number.isFinite(counterpart.columns.v0[at]) &&
          time + recording.start - counterpart.start - counterpart.columns.t[at] <= FADE_S;
        circle.style.display = seen ? "" : "none";
        if (!seen) continue;
        circle.dataset.row = at;
        const place = other.view.at(at), shift = [0, 1].map((axis) => counterpart.origin[axis] - recording.origin[axis]);
        circle.setAttribute("cx", px(place[0] + shift[0]));
        circle.setAttribute("cy", py(place[1] + shift[1]));
      }
      const known = Number.isFinite(e0[row]);
      part.truth.style.display = part.miss.style.display = known ? "" : "none";
      if (!known) return;
      const [u, v] = [px(view.truth(row)[0]), py(view.truth(row)[1])], [begin, end] = view.miss(row);
      part.truth.setAttribute("d", `M${u - 6},${v}h12M${u},${v - 6}v12`);
      for (const [name, value] of [["x1", px(begin[0])], ["y1", py(begin[1])], ["x2", px(end[0])], ["y2", py(end[1])]]) part.miss.setAttribute(name, value);
    });
  }

  return { load, draw };
}

/** Corners of the 95 % ellipse of a row, m; none without a covariance. */
function ellipse(columns, row) {
  const a = columns.s0[row] ** 2, b = columns.cov[row], c = columns.s1[row] ** 2;
  if (!(a > 0 && a * c - b * b > 0)) return [];
  // Cholesky factor of the covariance: it takes the circle to the ellipse.
  const l11 = Math.sqrt(a), l21 = b / l11, l22 = Math.sqrt(c - l21 * l21), radius = Math.sqrt(LEVEL_95), corners = [];
  for (let k = 0; k < 40; k++) {
    const u = radius * Math.cos(k * Math.PI / 20), v = radius * Math.sin(k * Math.PI / 20);
    corners.push([columns.v0[row] + l11 * u, columns.v1[row] + l21 * u + l22 * v]);
  }
  return corners;
}
