// Charts of all rows of a recording: residuals by source, map of errors, calibration, distribution of errors.

const QUANTILES = ["lowerfence", "q1", "median", "q3", "upperfence"];

/** Each chart as its title, traces and layout. */
function chartsOf(recording) {
  const charts = [];
  for (const channel of recording.residuals.channels) {
    charts.push(boxChart(channel));
    if (channel.curves.length && channel.sources.length > 1) charts.push(curveChart(channel));
  }
  if (recording.map) charts.push(mapChart(recording));
  if (recording.calibration) charts.push(calibrationChart(recording.calibration));
  if (recording.distribution.length) charts.push(distributionChart(recording));
  return charts;
}

function boxChart(channel) {
  const kinds = [["estimated", "about the estimates", "#0072b2"], ["true", "about the truth", "#d55e00"]];
  const traces = kinds.filter(([kind]) => channel.boxes[kind]).map(([kind, name, colour]) => {
    const boxes = channel.boxes[kind], there = boxes.map((_, k) => k).filter((k) => boxes[k][1] !== null);
    const trace = { type: "box", name, x: there.map((k) => escaped(channel.sources[k])), marker: { color: colour }, offsetgroup: kind,
                    hoverinfo: "y", mean: there.map((k) => boxes[k][1]) };
    QUANTILES.forEach((quantile, q) => { trace[quantile] = there.map((k) => boxes[k][3 + q]); });
    return trace;
  });
  const named = channel.sources.length > 1 ? ` by ${channel.name === "range" ? "anchor" : "station"}` : "";
  return { title: `Residuals, ${channel.name}${named}`, note: "Boxes: median and half of the readings; whiskers: 90 %.", traces, layout: { boxmode: "group",
                             xaxis: { type: "category" }, yaxis: { title: { text: `measured − predicted (${channel.unit})` } } } };
}

function curveChart(channel) {
  const traces = channel.curves.map((curve) => ({
    type: "scatter", mode: "lines+markers", name: escaped(curve.source), x: curve.x, y: curve.y, customdata: curve.n,
    line: { color: lineColour(channel.sources.indexOf(curve.source)), width: 1.4 }, marker: { size: 5 },
    hovertemplate: `%{y:.3f} ${channel.unit}, %{customdata} readings`,
  }));
  return { title: `Mean residual about the truth, ${channel.name}`, traces, layout: { xaxis: { title: { text: channel.againstName } },
                             yaxis: { title: { text: `measured − true (${channel.unit})` } } } };
}

function mapChart(recording) {
  const { map, rig } = recording, [xFrom, yFrom] = recording.origin;
  const traces = [{
    type: "heatmap", x: map.x, y: map.y, z: map.rmse, customdata: map.count, colorscale: "Viridis", zmin: 0,
    colorbar: { title: { text: "RMSE (m)", side: "right" }, thickness: 12, outlinewidth: 0 }, xgap: 1, ygap: 1,
    hovertemplate: "%{z:.3f} m, %{customdata} rows<extra></extra>",
  }, ...mountedAt(rig.anchors, "anchor", "triangle-up"), ...mountedAt(rig.stations, "station", "square")];
  return { title: `Horizontal RMSE over the floor, cells of ${map.cell} m`, traces, layout: { showlegend: false,
                             xaxis: { title: { text: fromOrigin("x", xFrom) }, zeroline: false },
                             yaxis: { title: { text: fromOrigin("y", yFrom) }, zeroline: false, scaleanchor: "x" } } };
}

function calibrationChart(calibration) {
  const traces = [{ type: "scatter", mode: "lines", x: [0, 100], y: [0, 100], name: "correct covariances", hoverinfo: "skip",
                    line: { color: themed("soft"), dash: "dash", width: 1 } }];
  Object.entries(calibration.curves).forEach(([name, curve], k) => traces.push({
    type: "scatter", mode: "lines", name: `${name}: ${fixed(curve.share[95], 0)} % inside 95 %`, x: calibration.level, y: curve.share,
    line: { color: lineColour(k), width: 2 }, hovertemplate: "%{y:.1f} % of the rows<extra></extra>",
  }));
  return { title: "Truth inside the reported ellipses", traces, layout: { hovermode: "x",
                             xaxis: { title: { text: "level of the ellipse (%)" }, range: [0, 100] },
                             yaxis: { title: { text: "rows with the truth inside (%)" }, range: [0, 101] } } };
}

function distributionChart(recording) {
  const unit = recording.axes[0].unit, ends = recording.distribution.map((curve) => curve.error[99]);
  const traces = recording.distribution.map((curve, k) => ({
    type: "scatter", mode: "lines", name: `${curve.name}: p95 ${withUnit(curve.error[95], unit)}`, x: curve.error, y: curve.share,
    line: { color: lineColour(k), width: 2 }, hovertemplate: `%{y:.0f} % within %{x:.${digitsOf(unit)}f} ${unit}<extra></extra>`,
  }));
  return { title: `Distribution of errors, ${recording.distribution[0].rows} rows`, traces, layout: { xaxis: { title: { text: `error (${unit})` }, range: [0, 1.1 * Math.max(...ends)] },
                             yaxis: { title: { text: "rows with at most this error (%)" }, range: [0, 101] } } };
}
