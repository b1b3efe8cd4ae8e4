"""The style sheet of the report: light, dark and print, one column on a phone, no font from elsewhere."""

from __future__ import annotations

_LIGHT = """
  --ground: #ffffff; --panel: #f5f6f8; --ink: #1b1f24; --soft: #5a6370; --line: #d5d9df; --accent: #1f5fa8;
  --good: #1a7f37; --weak: #9a6700; --failed: #b42318; --empty: #eceef1;
"""
_DARK = """
  --ground: #14171b; --panel: #1d2127; --ink: #e6e9ed; --soft: #9aa4b1; --line: #363d47; --accent: #79b0f0;
  --good: #4ac26b; --weak: #d9a521; --failed: #ff7b72; --empty: #23282f;
"""
_SEGMENTS = (
    *("#3b7dd8", "#e07b39", "#3a9e5c", "#c9426b", "#8a63c9", "#a8791f", "#1fa3a3", "#d160b4", "#7a9a2a", "#8b949e"),
)
_STATES = ("#4a90d9", "#d9a521", "#e07b39", "#c9304a", "#7d4a9e", "#6b727c")

_COLOURS = "\n".join(
    [f".f{k} {{ fill: {one}; }} .k{k} {{ stroke: {one}; }}" for k, one in enumerate(_SEGMENTS)]
    + [f".s{k} {{ fill: {one}; }} .b{k} {{ border-top-color: {one}; }}" for k, one in enumerate(_STATES)]
)

STYLE = f"""
:root {{ color-scheme: light dark; {_LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}
@media print {{ :root {{ color-scheme: light; {_LIGHT} }} section, figure, li {{ break-inside: avoid; }} }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: var(--ground); color: var(--ink); font: 15px/1.45 system-ui, sans-serif; }}
main {{ max-width: 1180px; margin: 0 auto; padding: 16px; overflow-wrap: anywhere; }}
h1 {{ font-size: 1.5rem; margin: 8px 0; }} h2 {{ font-size: 1.2rem; margin: 28px 0 8px; }}
h3 {{ font-size: 1rem; margin: 16px 0 6px; }} h4 {{ font-size: .9rem; margin: 12px 0 4px; }}
section {{ border-top: 1px solid var(--line); }}
a {{ color: var(--accent); }}
.level {{ display: inline-block; margin: 0 0 12px; padding: 4px 14px; border-radius: 4px; font-weight: 700;
  color: var(--ground); text-transform: uppercase; letter-spacing: .05em; }}
.level.good {{ background: var(--good); }} .level.weak {{ background: var(--weak); }}
.level.failed {{ background: var(--failed); }}
dl {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 8px; margin: 0; }}
dl div {{ background: var(--panel); padding: 8px 10px; border-radius: 4px; }}
dt {{ color: var(--soft); font-size: .8rem; }} dd {{ margin: 0; font-weight: 600; }}
.rule, figcaption {{ color: var(--soft); font-size: .85rem; }}
.figures {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(min(340px, 100%), 1fr)); gap: 18px; }}
.figures > * {{ min-width: 0; }}
figure {{ margin: 0; }}
svg {{ width: 100%; height: auto; display: block; }}
.strip {{ height: 26px; shape-rendering: crispEdges; }}
.scroll {{ overflow-x: auto; overflow-wrap: normal; }}
table {{ border-collapse: collapse; font-size: .87rem; margin: 6px 0; }}
th, td {{ text-align: right; padding: 3px 10px 3px 0; border-bottom: 1px solid var(--line); vertical-align: top;
  white-space: nowrap; }}
#images td, #matrix td, #loops td:nth-child(3), #models td, th {{ white-space: normal; }}
th {{ color: var(--soft); font-weight: 600; vertical-align: bottom; }}
th:first-child, td:first-child, th:nth-child(2), td:nth-child(2), #images td, #images th, #loops td:nth-child(3),
#matrix td:nth-child(3), #matrix th:nth-child(3) {{ text-align: left; }}
details {{ margin: 8px 0; }} summary {{ cursor: pointer; }}
pre {{ overflow-x: auto; background: var(--panel); padding: 10px; font-size: .8rem; }}
.cards {{ list-style: none; padding: 0; display: grid; gap: 10px;
  grid-template-columns: repeat(auto-fill, minmax(112px, 1fr)); }}
.cards li {{ background: var(--panel); border-top: 4px solid; padding: 6px; font-size: .75rem; line-height: 1.3; }}
.cards li:target {{ outline: 3px solid var(--accent); }}
.cards img {{ display: block; max-width: 100%; margin: 0 auto 4px; }}
.cards b, .cards span {{ display: block; }} .cards span {{ color: var(--soft); }}
img.small {{ max-height: 56px; max-width: 84px; }}
.key {{ font-size: .8rem; color: var(--soft); margin: 6px 0; }}
.key span {{ margin-right: 14px; white-space: nowrap; }}
.key svg {{ width: 10px; height: 10px; display: inline-block; }}
.wall {{ display: block; height: 10px; margin-top: 5px; background: var(--accent); }}
#cost td:nth-child(2) {{ width: 30vw; min-width: 80px; }}
.t {{ font-size: 11px; fill: var(--soft); }} .up {{ writing-mode: vertical-rl; }}
.limit-t {{ fill: var(--failed); }} .halo {{ fill: var(--ink); paint-order: stroke; stroke: var(--ground);
  stroke-width: 3px; }}
.grid {{ stroke: var(--line); stroke-width: 1; }} .limit {{ stroke: var(--failed); stroke-dasharray: 4 3; }}
.bar {{ fill: var(--accent); }} .line {{ fill: none; stroke: var(--accent); stroke-width: 1.3; }}
.path {{ fill: none; stroke-width: 1.6; }} .loop {{ stroke: var(--good); stroke-width: 1.6; }}
.loop.refused {{ stroke: var(--failed); stroke-dasharray: 4 3; }}
.empty {{ fill: var(--empty); }} .pixels {{ image-rendering: pixelated; }}
.cell {{ fill: var(--soft); }} .frame {{ fill: none; stroke: var(--line); }}
.arrow {{ stroke: var(--accent); stroke-width: 1.3; }} .arrow-start {{ fill: var(--accent); }}
{_COLOURS}
"""
