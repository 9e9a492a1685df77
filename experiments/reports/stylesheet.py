"""How the page looks: one column of text and tables, drawings two abreast on a desk and one on a phone or on paper."""

STYLESHEET = """
:root { --ink: #1d2733; --soft: #5b6875; --line: #dfe4ea; --wash: #f5f7f9; --blue: #0072b2; --warn: #b34700;
  --warnwash: #fdf4ec; --good: #00724f; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.55 "Helvetica Neue", Arial, "Liberation Sans", sans-serif; font-variant-numeric: tabular-nums; }
main { max-width: 66rem; margin: 0 auto; padding: 2.5rem 1.5rem 4rem; }
header { border-bottom: 1px solid var(--line); padding-bottom: 1.6rem; }
.kind { margin: 0 0 .5rem; color: var(--soft); font-size: .82rem; letter-spacing: .06em; text-transform: uppercase; }
h1 { margin: 0 0 1rem; font-size: clamp(1.55rem, 1.2rem + 1.6vw, 2.2rem); line-height: 1.15; font-weight: 700;
  letter-spacing: -.015em; text-wrap: balance; }
.verdict { margin: 0; max-width: 48rem; font-size: clamp(1.05rem, 1rem + .35vw, 1.25rem); line-height: 1.45; }
.verdict b { color: var(--good); }
.verdict.beware b { color: var(--warn); }
.warnings { margin: 1.2rem 0 0; padding: .9rem 1.2rem .9rem 2.2rem; background: var(--warnwash);
  border-left: 3px solid var(--warn); max-width: 52rem; }
.warnings li + li { margin-top: .5rem; }
section { margin-top: 2.8rem; }
h2 { margin: 0 0 .35rem; font-size: 1.22rem; line-height: 1.25; letter-spacing: -.005em; }
.lead { margin: 0 0 1rem; max-width: 48rem; color: var(--soft); font-size: .94rem; }
dl { display: grid; grid-template-columns: 9.5rem 1fr; gap: .45rem 1.2rem; margin: 0; font-size: .95rem; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
code, pre { font: .86em/1.5 Menlo, Consolas, "Liberation Mono", monospace; }
pre { margin: .4rem 0; padding: .8rem 1rem; background: var(--wash); border-radius: 4px; white-space: pre-wrap;
  overflow-wrap: anywhere; }
code span, pre span { display: inline-block; max-width: 100%; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .93rem; }
th { color: var(--soft); font-weight: 400; font-size: .84rem; text-align: right; vertical-align: bottom;
  line-height: 1.25; }
th, td { padding: .5rem .7rem; border-bottom: 1px solid var(--line); }
thead tr:last-child th { border-bottom: 1px solid var(--ink); }
th.group { text-align: center; border-bottom: 1px solid var(--line); }
td { text-align: right; white-space: nowrap; }
thead tr:first-child th:first-child, td:first-child { text-align: left; padding-left: 0; }
td:first-child { white-space: normal; overflow-wrap: anywhere; }
td.after { font-weight: 700; }
td .unit, td .small { color: var(--soft); font-weight: 400; font-size: .86em; }
td .small { display: block; }
tr.goal td:first-child { font-weight: 700; }
.better { color: var(--good); }
.worse { color: var(--warn); font-weight: 700; }
.charts { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1.6rem 2rem; align-items: start; }
p.under { margin: 1.2rem 0 .6rem; color: var(--soft); font-size: .94rem; }
.charts + .charts { margin-top: 1.6rem; }
.charts.three { grid-template-columns: repeat(3, minmax(0, 1fr)); gap: 1.6rem; }
figure { margin: 0; break-inside: avoid; }
figure img { display: block; width: 100%; height: auto; }
figcaption { margin-top: .35rem; color: var(--soft); font-size: .86rem; line-height: 1.45; max-width: 44rem; }
footer { margin-top: 3rem; padding-top: 1rem; border-top: 1px solid var(--line);
  color: var(--soft); font-size: .84rem; }
@media screen and (max-width: 720px) {
  main { padding: 1.4rem 1rem 3rem; }
  section { margin-top: 2.2rem; }
  .charts, .charts.three { grid-template-columns: minmax(0, 1fr); }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: .6rem; }
  thead { display: none; }
  tr { display: grid; grid-template-columns: repeat(3, 1fr); gap: .35rem .8rem; padding: .7rem 0;
    border-bottom: 1px solid var(--line); }
  table.numbers tr { grid-template-columns: repeat(2, 1fr); }
  td, td:first-child { padding: 0; border: 0; text-align: left; white-space: normal; }
  td:first-child { grid-column: 1 / -1; font-weight: 700; }
  td::before { content: attr(data-label); display: block; color: var(--soft); font-weight: 400; font-size: .78rem; }
  td:first-child::before { content: none; }
}
@media print {
  @page { margin: 16mm 14mm; }
  body { font-size: 10pt; }
  main { max-width: none; padding: 0; }
  section { margin-top: 1.6rem; }
  h2, .lead { break-after: avoid; }
  tr, .warnings, #asked, #numbers, #scores { break-inside: avoid; }
  .scroll { overflow: visible; }
}
"""
