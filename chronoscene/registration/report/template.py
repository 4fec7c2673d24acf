"""Template of ``registration.html``; `chronoscene.registration.report.page` fills it in."""

from __future__ import annotations

PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:;
  style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>{{ levels[verdict.level] }} · {{ title }}</title>
<style>
:root { --bg: #f6f7f8; --card: #fff; --ink: #1b1f24; --dim: #5c6670; --line: #dde1e5;
  --fail: #b3261e; --doubtful: #8a5a00; --pass: #1c6e3c; --link: #1f5fa8; --dot: #b9c0c7; }
@media (prefers-color-scheme: dark) {
  :root { --bg: #14171a; --card: #1d2125; --ink: #e6e9ec; --dim: #9aa4ae; --line: #343a41;
    --fail: #ff8a80; --doubtful: #f0b955; --pass: #7fd3a0; --link: #82b6f5; --dot: #4a525a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 1rem; background: var(--bg); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; margin: .5rem 0; }
h2 { font-size: 1.2rem; margin: 0 0 .5rem; }
h3 { font-size: 1.05rem; margin: 1.25rem 0 .25rem; overflow-wrap: anywhere; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: .6rem;
  padding: 1rem; margin: 1rem 0; }
.verdict { border-left: 6px solid var(--line); }
.verdict.pass { border-left-color: var(--pass); } .verdict.fail { border-left-color: var(--fail); }
.verdict.doubtful { border-left-color: var(--doubtful); }
.badge { font-weight: 700; } .dim { color: var(--dim); font-size: .92rem; }
.pass > .badge, .badge.pass { color: var(--pass); } .pass line, line.pass { stroke: #36c275; }
.fail > .badge, .badge.fail { color: var(--fail); } line.fail { stroke: #ff4d3d; }
.doubtful > .badge, .badge.doubtful { color: var(--doubtful); } line.doubtful { stroke: #ffb020; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .25rem .75rem .25rem 0; vertical-align: top;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--dim); }
td { overflow-wrap: anywhere; } td.number { white-space: nowrap; overflow-wrap: normal; }
ul { margin: .5rem 0; padding-left: 1.25rem; } li { margin: .25rem 0; }
svg { display: block; width: 100%; height: auto; }
.legend { display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; margin: .25rem 0 .75rem; }
.legend i { display: inline-block; width: .8rem; height: .8rem; border-radius: 50%;
  margin-right: .35rem; vertical-align: -1px; }
.flickers { display: grid; grid-template-columns: repeat(auto-fill, minmax(15.5rem, 1fr));
  gap: 1rem; }
figure { margin: 0; min-width: 0; }
figcaption { font-size: .85rem; color: var(--dim); overflow-wrap: anywhere; }
.stack { position: relative; aspect-ratio: 1; background: #808080; border-radius: .4rem;
  overflow: hidden; }
.stack img { position: absolute; inset: 0; width: 100%; height: 100%; }
.stack b { position: absolute; left: .4rem; top: .4rem; padding: 0 .4rem; border-radius: .25rem;
  background: #000a; color: #fff; font-size: .8rem; }
.stack .second { opacity: .5; } .stack b.second { left: auto; right: .4rem; opacity: 1; }
.stack:after { content: ""; position: absolute; left: 50%; top: 50%; width: 22px; height: 22px;
  margin: -11px; border: 2px solid #fff; outline: 1px solid #000; border-radius: 50%;
  opacity: .65; }
.controls { display: flex; align-items: center; gap: .6rem; margin: .35rem 0; font-size: .9rem; }
.controls input[type=range] { flex: 1; min-width: 4rem; accent-color: var(--link); }
.controls label { white-space: nowrap; }
input[type=checkbox] { width: 1.1rem; height: 1.1rem; accent-color: var(--link);
  vertical-align: -2px; }
@keyframes blink { 0%, 49.9% { opacity: 0; } 50%, 100% { opacity: 1; } }
figure:has(.blink:checked) img.second { animation: blink 1.2s linear infinite; }
@media (prefers-reduced-motion: reduce) {
  figure:has(.blink:checked) img.second { animation-duration: 6s; } }
details { margin: .25rem 0; } summary { cursor: pointer; }
code { font: .9em ui-monospace, monospace; overflow-wrap: anywhere; }
footer { margin: 2rem 0 1rem; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<section class="card verdict {{ verdict.level }}">
<h2 class="badge {{ verdict.level }}">{{ levels[verdict.level] }}</h2>
<p>{{ verdict.text }}</p>
{% if verdict.findings %}
<details{% if verdict.level != "pass" %} open{% endif %}>
<summary>{{ verdict.findings|length }} finding{{ "" if verdict.findings|length == 1 else "s" }}\
</summary>
<ul>
{% for f in verdict.findings %}
<li class="{{ f.level }}"><span class="badge">{{ levels[f.level] }}</span>,
{{ f.place }}: {{ f.found }}<br><span class="dim">{{ f.why }}</span></li>
{% endfor %}
</ul>
</details>
<p><b>What to do</b></p>
<ul>
{% for todo in verdict.todo[:5] %}
<li>{{ todo }}</li>
{% endfor %}
</ul>
{% endif %}
<p class="dim">Route {{ certificate.route }}; {{ certificate.labels|length }} periods; extent of the
cameras {{ "%.4g"|format(certificate.extent) }}
{{ "m" if certificate.unit == "metre" else "units (no scale is known)" }}.</p>
</section>

{% if map %}
<section class="card">
<h2>Cameras from above</h2>
<div class="legend">
{% for label in certificate.labels %}
<span><i style="background: {{ colors[loop.index0] }}"></i>{{ label }}</span>
{% endfor %}
</div>
<svg viewBox="0 0 {{ map.width }} {{ map.height }}" role="img"
  aria-label="Map of the cameras by period">
<g fill="var(--dot)">
{% for x, y in map.dots %}<circle cx="{{ x }}" cy="{{ y }}" r="1"/>{% endfor %}
</g>
{% for c in map.cameras %}
<g stroke="{{ colors[c.period] }}" fill="{{ colors[c.period] }}">
<title>{{ c.name }}</title>
{% if c.gps %}<line x1="{{ c.x }}" y1="{{ c.y }}" x2="{{ c.gps[0] }}" y2="{{ c.gps[1] }}"
  stroke-width="1" stroke-opacity=".55" {% if c.cut %}stroke-dasharray="4 4"{% endif %}/>
{% if not c.cut %}<circle cx="{{ c.gps[0] }}" cy="{{ c.gps[1] }}" r="2.2" fill="none"/>{% endif %}
{% endif %}
<line x1="{{ c.x }}" y1="{{ c.y }}" x2="{{ c.tip[0] }}" y2="{{ c.tip[1] }}" stroke-width="2"/>
<circle cx="{{ c.x }}" cy="{{ c.y }}" r="4" stroke="none"/>
</g>
{% endfor %}
<g stroke="var(--ink)" stroke-width="2">
<line x1="16" y1="{{ map.height - 14 }}" x2="{{ 16 + map.bar }}" y2="{{ map.height - 14 }}"/></g>
<text x="16" y="{{ map.height - 20 }}" fill="var(--ink)" font-size="14">{{ map.bar_label }}</text>
{% if map.north %}<text x="{{ map.width - 24 }}" y="22" fill="var(--ink)" font-size="15"
  text-anchor="middle">N ↑</text>{% endif %}
</svg>
<p class="dim">A tick shows where a camera looks; a thin line ends in a ring where its GPS says that
it was.{% if map.gross %} Dashed: {{ map.gross }} positions farther off than drawn.{% endif %}</p>
</section>
{% endif %}

{% if flickers %}
<section class="card">
<h2>The same spot at two dates</h2>
<p class="dim">Both pictures show one square of the model's surface. Ground and walls that did not
change must stay where they are when the picture blinks; if they jump, the periods do not fit.</p>
<p class="controls"><label><input type="checkbox" id="all"> Blink all</label></p>
<div class="flickers">
{% for f in flickers %}
<figure>
<div class="stack">
<img src="{{ f.pictures[0] }}" alt="{{ f.labels[0] }}">
<img class="second" src="{{ f.pictures[1] }}" alt="{{ f.labels[1] }}">
<b>{{ f.labels[0] }}</b><b class="second">{{ f.labels[1] }}</b>
</div>
<div class="controls"><input type="range" min="0" max="100" value="50"
  aria-label="Share of {{ f.labels[1] }}">
<label><input type="checkbox" class="blink"> Blink</label></div>
<figcaption>{{ "At a tie point" if f.tied else "Where there is no tie point" }}:
{{ f.names[0] }}, {{ f.names[1] }}</figcaption>
</figure>
{% endfor %}
</div>
</section>
{% endif %}

{% if drawn %}
<section class="card">
<h2>Held-out matches between periods</h2>
<p class="dim">Lines by how far the point of one period lies from its match in the other image:
<span class="badge pass">below 2 px</span>, <span class="badge doubtful">below 5 px</span>,
<span class="badge fail">more</span>.</p>
{% for p in drawn %}
<h3>{{ p.title }}: {{ "%.2f"|format(p.median) }} px (median of {{ p.matches }} matches)</h3>
<p class="dim"><code>{{ p.names[0] }}</code> and <code>{{ p.names[1] }}</code></p>
<svg viewBox="0 0 {{ 2 * photo_width + 8 }} {{ p.heights|max }}" role="img"
  aria-label="Matches of two photos">
<image href="{{ p.pictures[0] }}" width="{{ photo_width }}" height="{{ p.heights[0] }}"/>
<image href="{{ p.pictures[1] }}" x="{{ photo_width + 8 }}" width="{{ photo_width }}"
  height="{{ p.heights[1] }}"/>
<g stroke-width="1" stroke-opacity=".8">
{% for l in p.lines %}<line class="{{ l.level }}" x1="{{ l.x1 }}" y1="{{ l.y1 }}"
  x2="{{ l.x2 + photo_width + 8 }}" y2="{{ l.y2 }}"/>{% endfor %}
</g>
</svg>
{% endfor %}
</section>
{% endif %}

{% if ties %}
<section class="card">
<h2>Clicked tie points</h2>
<ul>
{% for remark in ties.remarks %}<li>{{ remark }}</li>{% endfor %}
</ul>
<div class="scroll"><table>
<tr><th>point</th><th>clicks</th><th>periods</th><th>residual, px</th>
<th>{{ "to control" if ties.controlled else "between periods" }},
{{ "m" if certificate.unit == "metre" or ties.controlled else "units" }}</th><th></th></tr>
{% for r in ties.residuals %}
<tr><td>{{ r.name }}</td><td class="number">{{ r.clicks }}</td><td>{{ r.periods|join(", ") }}</td>
<td class="number">{{ "%.2f"|format(r.pixels) if r.pixels is not none else "-" }}</td>
<td class="number">{{ "%.3g"|format(r.distance) if r.distance is not none else "-" }}</td>
<td>{% if r.outlier %}<span class="badge fail">outlier</span> {% endif %}{{ r.note }}</td></tr>
{% endfor %}
</table></div>
</section>
{% endif %}

{% if clicks %}
<section class="card">
<h2>Where to click next</h2>
<p>Find each spot in all of its images and write one line for each click,
<code>point,image,x,y</code>, into a file; then run the command again with
<code>--tie-points</code>. The pixels below are where this registration puts the spot: near it, if
the registration is nearly right. Any corner that is still there on both dates will do.</p>
{% for names, rows in clicks %}
<h3>{{ names }}</h3>
<div class="scroll"><table>
<tr><th>point</th><th>period</th><th>image</th><th>near x, y</th></tr>
{% for row in rows %}
{% set number = loop.index %}
{% for label, image, x, y in row.places %}
<tr><td>{{ "p%d"|format(number) if loop.first else "" }}</td><td>{{ label }}</td>
<td>{{ image }}</td><td class="number">{{ "%.0f, %.0f"|format(x, y) }}</td></tr>
{% endfor %}
{% endfor %}
</table></div>
{% endfor %}
</section>
{% endif %}

<section class="card">
<h2>Certificate</h2>
{% for names, level, figures in pairs %}
<h3>Periods {{ names }}: <span class="badge {{ level or '' }}">{{ levels[level] }}</span></h3>
<div class="scroll"><table>
<tr><th>figure</th><th>value (95% interval)</th><th>over</th></tr>
{% for f in figures %}
<tr><td>{{ f.name }}</td><td{% if f.value is not none %} class="number"{% endif %}>{{ f.text }}</td>
<td class="dim">{{ f.over }}</td></tr>
{% endfor %}
</table></div>
{% endfor %}
{% for p, figures in periods %}
<h3>Period {{ p.label }}</h3>
<div class="scroll"><table>
<tr><th>figure</th><th>value (95% interval)</th><th>over</th></tr>
{% for f in figures %}
<tr><td>{{ f.name }}</td><td{% if f.value is not none %} class="number"{% endif %}>{{ f.text }}</td>
<td class="dim">{{ f.over }}</td></tr>
{% endfor %}
{% for reason, count in p.reasons|dictsort %}
<tr><td>not registered</td><td class="number">{{ count }}</td><td>{{ reason }}</td></tr>
{% endfor %}
</table></div>
{% endfor %}
{% if unregistered %}
<details><summary>{{ unregistered|length }} photos without a pose</summary>
<ul>
{% for name, reason in unregistered[:500] %}
<li><code>{{ name }}</code>: {{ reason }}</li>
{% endfor %}
</ul></details>
{% endif %}
<details><summary>Thresholds, and why</summary>
<div class="scroll"><table>
<tr><th>figure</th><th>doubtful</th><th>fail</th><th>reason</th></tr>
{% for t in thresholds %}
{% set sign = "below" if t.larger_is_better else "above" %}
<tr><td>{{ t.what }}</td>
<td class="number">{{ sign }} {{ "%g"|format(t.doubtful) }} {{ t.unit if t.unit|length < 9 }}</td>
<td class="number">{{ "%s %g"|format(sign, t.fail) if t.fail is not none else "-" }}</td>
<td>{{ t.why }}</td></tr>
{% endfor %}
</table></div></details>
</section>
<footer class="dim">chronoscene {{ version }} register. docs/registration.md explains every figure.\
</footer>
<script>
for (const figure of document.querySelectorAll(".flickers figure")) {
  const second = figure.querySelector("img.second");
  figure.querySelector("input[type=range]").addEventListener("input", (event) => {
    figure.querySelector(".blink").checked = false;
    second.style.opacity = event.target.value / 100;
  });
}
document.querySelector("#all")?.addEventListener("change", (event) => {
  for (const box of document.querySelectorAll(".blink")) box.checked = event.target.checked;
});
</script>
</body>
</html>
"""
