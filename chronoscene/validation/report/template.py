"""Template of the HTML report; `report_html` fills it in."""

from __future__ import annotations

PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{{ "Valid" if valid else "Not valid" }} · chronoscene validate</title>
<style>
:root { --bg: #f6f7f8; --card: #fff; --ink: #1b1f24; --dim: #5c6670; --line: #dde1e5;
  --error: #b3261e; --warning: #8a5a00; --info: #1f5fa8; --good: #1c6e3c; }
@media (prefers-color-scheme: dark) {
  :root { --bg: #14171a; --card: #1d2125; --ink: #e6e9ec; --dim: #9aa4ae; --line: #343a41;
    --error: #ff8a80; --warning: #f0b955; --info: #82b6f5; --good: #7fd3a0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 1rem; background: var(--bg); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; margin: .5rem 0; }
h2 { font-size: 1.25rem; margin: 0 0 .25rem; overflow-wrap: anywhere; }
h3 { font-size: 1.05rem; margin: 1.25rem 0 .5rem; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: .6rem;
  padding: 1rem; margin: 1rem 0; }
.dim { color: var(--dim); }
.error { color: var(--error); } .warning { color: var(--warning); } .info { color: var(--info); }
.good { color: var(--good); }
a { color: var(--info); }
.counts { display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; margin: .25rem 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0; }
th, td { text-align: right; padding: .15rem .5rem .15rem 0; white-space: nowrap; }
th { font-weight: 600; color: var(--dim); }
details { border-top: 1px solid var(--line); padding: .5rem 0; }
summary { cursor: pointer; overflow-wrap: anywhere; }
code { font: .9em ui-monospace, monospace; }
ul { list-style: none; margin: .5rem 0; padding: 0; }
li { display: flex; gap: .75rem; margin: .35rem 0; padding: .35rem 0 .35rem .75rem;
  border-left: 3px solid var(--line); }
li div { min-width: 0; overflow-wrap: anywhere; }
@media (max-width: 40rem) { li { flex-wrap: wrap; } li div { flex-basis: 100%; } }
img { width: 7.5rem; height: 6rem; object-fit: cover; border-radius: .3rem; flex: none; }
.todo { margin: .25rem 0 .25rem .75rem; }
footer { margin: 2rem 0 1rem; font-size: .9rem; }
</style>
</head>
<body>
<h1>{{ scenes|length }} scene{{ "" if scenes|length == 1 else "s" }}:
{% if valid %}<span class="good">valid</span>{% else %}<span class="error">not valid</span>\
{% endif %}</h1>
<div class="counts">
{% for severity in severities %}
<span class="{{ severity }}"><b>{{ total[severity] }}</b>
{{ titles[severity]|lower if total[severity] != 1 else titles[severity][:-1]|lower }}</span>
{% endfor %}
</div>
{% if scenes|length > 1 %}
<ul>
{% for report, sections, skipped in scenes %}
<li><a href="#scene{{ loop.index }}">{{ report.name }}</a>
<span class="dim">{{ report.count("error") }} errors,
{{ report.count("warning") }} warnings</span></li>
{% endfor %}
</ul>
{% endif %}
{% for report, sections, skipped in scenes %}
<section class="card" id="scene{{ loop.index }}">
<h2>{{ report.name }}
{% if is_valid(report) %}<span class="good">valid</span>{% else %}\
<span class="error">not valid</span>{% endif %}</h2>
{% set s = report.summary %}
<div class="dim counts">
{% for number, noun in ((s.images, "registered image"), (s.image_files, "image file"),
  (s.cameras, "camera"), (s.points, "point"), (s.observations, "observation")) %}
<span>{{ "{:,}".format(number) if number is not none else "unknown" }}
{{ noun }}{{ "" if number == 1 else "s" }}</span>
{% endfor %}
</div>
{% if s.periods %}
<div class="scroll"><table>
<tr><th>period</th><th>images</th><th>train</th><th>test</th><th>error, px</th></tr>
{% for p in s.periods[:100] %}
<tr><td>{{ p.id }}</td><td>{{ p.images }}</td>
<td>{{ p.train if p.train is not none else "-" }}</td>
<td>{{ p.test if p.test is not none else "-" }}</td>
<td>{{ "%.2f"|format(p.reprojection_px) if p.reprojection_px is not none else "-" }}</td></tr>
{% endfor %}
</table></div>
{% if s.periods|length > 100 %}<p class="dim">and {{ s.periods|length - 100 }} more periods</p>\
{% endif %}
{% endif %}
{% for severity, blocks in sections %}
<h3 class="{{ severity }}">{{ titles[severity] }}</h3>
{% for block in blocks %}
<details{% if severity != "info" and block.total <= 10 %} open{% endif %}>
<summary><b class="{{ severity }}">{{ block.code }}</b> <code>{{ block.name }}</code>
{% if block.total > 1 %}<span class="dim">({{ block.total }})</span> {% endif %}
{{ block.what|replace("`", "") }}</summary>
<ul>
{% for row in block.rows %}
<li>{% for picture in row.pictures %}<img src="{{ picture }}" alt="">{% endfor %}
<div><code>{{ row.place }}</code><br>
expected {{ row.expected }},<br>found {{ row.found }}</div></li>
{% endfor %}
</ul>
{% if block.total > block.rows|length %}
<p class="dim todo">and {{ block.total - block.rows|length }} more
(<code>--format json</code> has all)</p>
{% endif %}
{% for remedy in block.remedies %}
<p class="todo"><b>To do:</b> {{ remedy }}</p>
{% endfor %}
</details>
{% endfor %}
{% else %}
<p class="good">Nothing found.</p>
{% endfor %}
{% for reason, codes in skipped %}
<p class="dim">Not checked ({{ reason }}): {{ codes }}</p>
{% endfor %}
</section>
{% endfor %}
<footer class="dim">chronoscene {{ version }} validate. DATASET.md describes every rule.</footer>
</body>
</html>
"""
