"""The look of the report: one style sheet, readable in light and dark."""

CSS = """
:root { color-scheme: light dark; --ink: #22262b; --muted: #6a727b; --line: #dfe3e7; --paper: #ffffff;
  --soft: #f5f7f8; --good: #2c7a4b; --bad: #b3301e; }
@media (prefers-color-scheme: dark) { :root { --ink: #e3e6e9; --muted: #99a2ab; --line: #363c43;
  --paper: #17191c; --soft: #1f2327; --good: #6cc08b; --bad: #ef7e6c; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1060px; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .4rem; font-weight: 650; }
h1 em { font-style: normal; color: var(--muted); }
h2 { font-size: 1.25rem; margin: 2.8rem 0 .8rem; padding-top: .9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 1.6rem 0 .2rem; }
p { margin: .4rem 0 .8rem; max-width: 46rem; }
.lead { font-size: 1.08rem; } .meta, .sem { color: var(--muted); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(180px, 1fr)); gap: .8rem; margin: 1.4rem 0; }
.card { background: var(--soft); border-radius: 8px; padding: .8rem 1rem; }
.card small { display: block; color: var(--muted); } .card b { font-size: 1.4rem; font-weight: 600; }
.card b { white-space: nowrap; } .card b .sem { font-size: .95rem; font-weight: 400; }
.warning { color: var(--bad); }
.plot { display: block; max-width: 100%;
  max-height: 46rem; margin: 0 auto; border-radius: 8px; background: white; padding: .5rem; }
.scroll { overflow-x: auto; }
@media screen {
  /* A table wider than the text goes on to the edge of the window; where it is cut even so, there is a shadow. */
  .scroll:has(table) { width: max-content; min-width: 100%;
    max-width: calc(100vw - 2.5rem - max(0px, (100vw - 1060px) / 2)); }
  .scroll { background: linear-gradient(to left, var(--paper) 1rem, transparent) right / 2rem 100% no-repeat local,
    linear-gradient(to left, var(--line), transparent) right / 1rem 100% no-repeat; }
}
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; margin: .5rem 0 .8rem; }
th, td { text-align: right; padding: .28rem .8rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--muted); font-weight: 500; }
th.text, td.text { text-align: left; }
.findings th:first-child, .findings td:first-child { text-align: left; }
.findings ul { max-width: 46rem; padding-left: 1.2rem; } .findings li { margin: .35rem 0; } th:first-child, td:first-child { padding-left: 0; }
td:nth-child(3).text { white-space: normal; min-width: 8rem; }
.finished { color: var(--good); } .failed, .diverged { color: var(--bad); font-weight: 600; }
.missing, .interrupted { color: var(--muted); }
.checks { list-style: none; margin: .6rem 0; padding: 0; border: 1px solid var(--line); border-radius: 8px; }
.checks li { display: flex; gap: .7rem; padding: .5rem .9rem; border-top: 1px solid var(--line); font-size: .95rem; }
.checks li:first-child { border-top: 0; } .checks .mark { flex: 0 0 1.1rem; font-weight: 700; text-align: center; }
.checks div { min-width: 0; overflow-wrap: anywhere; }
.checks .bad { background: color-mix(in srgb, var(--bad) 9%, transparent); }
.good .mark { color: var(--good); } .bad .mark, .bad b { color: var(--bad); } .open .mark { color: var(--muted); }
.trios { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 1.1rem 1.2rem;
  margin: .8rem 0; }
.trio { margin: 0; min-width: 0; } .trio figcaption { font-weight: 600; font-size: .9rem; margin-bottom: .2rem; }
.trio img { display: block; width: 100%; image-rendering: pixelated; background: white; border-radius: 4px; }
.trio div { display: grid; grid-auto-flow: column; grid-auto-columns: 1fr; font-size: .76rem; color: var(--muted);
  text-align: center; }
.paper { display: none; }
.strip { margin: 1.1rem 0; } .strip figcaption { font-weight: 600; font-size: .92rem; }
.strip div { display: flex; align-items: center; gap: .8rem; margin: 3px 0; }
.strip span { flex: 0 0 6.6rem; color: var(--muted); font-size: .82rem; }
.strip img { flex: 1; min-width: 0; width: 100%; image-rendering: pixelated; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem; font-size: .9rem; }
dt { color: var(--muted); } dd { margin: 0; overflow-wrap: anywhere; }
code, pre { font: .86em/1.45 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
pre { background: var(--soft); padding: 1rem; border-radius: 8px; overflow-x: auto; }
summary { cursor: pointer; color: var(--muted); margin: .8rem 0; }
td.text:last-child:nth-child(n+4) { white-space: normal; min-width: 11rem; }
#section-fits td.text { white-space: normal; }
@media screen { #section-fits td.text:last-child { min-width: 18rem; } }
nav ul { columns: 15rem; padding: 0; margin: 0 0 1.4rem; list-style: none; font-size: .9rem; }
nav li { break-inside: avoid; } nav a { color: inherit; text-decoration-color: var(--muted); }
tbody th { color: inherit; font-weight: inherit; } .sem { white-space: nowrap; }
thead th { white-space: normal; vertical-align: bottom; }
th:first-child, .findings td:first-child { white-space: normal; min-width: 7rem; }
@media screen { th:first-child, .findings td:first-child { position: sticky; left: 0; background: var(--paper); } }
.pause { font-size: .86rem; color: var(--muted); }
.moving, .still { display: contents; } .still, body:has(#pause:checked) .moving { display: none; }
body:has(#pause:checked) .still { display: contents; }
@media (prefers-reduced-motion: reduce) { .moving, .pause { display: none; } .still { display: contents; } }
@media (max-width: 560px) { th:first-child, .findings td:first-child { max-width: 9rem; overflow-wrap: anywhere; }
  main { padding: 1.2rem .9rem 3rem; } h1 { font-size: 1.5rem; }
  .cards { grid-template-columns: repeat(2, minmax(0, 1fr)); }
  .card { padding: .6rem .7rem; } .card b { font-size: 1.15rem; } .card b .sem { font-size: .8rem; }
  .strip div { display: block; } .plot { padding: .2rem; max-width: none; max-height: none;
  width: max(100%, var(--wide)); } dl { grid-template-columns: 1fr; } dd { margin-bottom: .5rem; } }
@media print { :root { color-scheme: light; --ink: #000; --muted: #444; --line: #bbb; --paper: #fff; --soft: #f5f7f8;
    --good: #1d5c36; --bad: #9c2415; }
  @page { margin: 14mm; } body { font-size: 10.5pt; } main { max-width: none; padding: 0; }
  .trios, .pause, .more { display: none; } .paper { display: block; } pre { font-size: 6.5pt; white-space: pre-wrap; }
  details pre { columns: 3; }
  details::details-content { content-visibility: visible; block-size: auto; } .scroll { overflow: visible; }
  table { font-size: 7.5pt; } th, td { padding: .15rem .35rem; white-space: normal; }
  td:nth-child(3).text { min-width: 0; }
  table:has(th:nth-child(13)) .sem { display: block; }  /* errors below their numbers: side by side they do not fit */
  /* One table wider than the paper would have the browser print the whole page smaller. */
  table:has(th:nth-child(13)) { font-size: 6pt; } table:has(th:nth-child(13)) :is(th, td) { padding-inline: .1rem; }
  .plot { max-height: 100mm; }
  figure, .card, .checks li, tr, .plot { break-inside: avoid; } h2, h3, h4, summary { break-after: avoid; } }
"""
