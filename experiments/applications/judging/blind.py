"""A page on which a person labels successes without knowing the policy or what the judges say, and what the labels say.

The world is not named, but can be seen: true frames are sharp, the model's are not. True frames are shown as the judges
see them; decoded by the tokenizer they would be blurred too, but would have none of the errors that the model makes."""

from __future__ import annotations

import hashlib
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments.analysis.intervals import Interval
from experiments.applications.judging.agreement import rate_interval
from experiments.applications.judging.judge import Judgement
from experiments.applications.judging.outcomes import HEAD, LEARNED, STATE, TRUE, Outcome
from experiments.report.pieces import animation, data_uri
from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import write_file

ENLARGED = 3
SHOW_MS, HOLD_MS = 200, 1200

SCRIPT = """
const KEPT = `hma labels ${document.body.dataset.page}`;
let labels = {}, unkept = {};  // a browser may keep nothing
let at = 0, unsaved = false;
function merge() {  // another window of this page may have added some
  let stored = {};
  try { stored = JSON.parse(localStorage.getItem(KEPT)) ?? {}; } catch {}
  labels = {...labels, ...stored, ...unkept};
}
const clips = [...document.querySelectorAll('img')];
function show() {
  clips.forEach((clip, i) => { clip.hidden = i !== at; });
  const done = Object.keys(labels).length;
  document.getElementById('where').textContent = `${at + 1} of ${clips.length}, ${done} labelled: ` +
    ({true: 'success', false: 'failure'}[labels[clips[at].dataset.clip]] ?? 'not labelled') +
    (unsaved ? '. This browser does not keep labels: save labels.json before you leave or reload this page' : '');
}
function label(value) {
  unkept[clips[at].dataset.clip] = value;
  merge();
  try { localStorage.setItem(KEPT, JSON.stringify(labels)); unkept = {}; } catch {}
  unsaved = Object.keys(unkept).length > 0;
  move(1);
}
function move(by) { at = Math.min(Math.max(at + by, 0), clips.length - 1); show(); }
document.addEventListener('keydown', (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  const keys = {s: () => label(true), f: () => label(false), arrowleft: () => move(-1), arrowright: () => move(1)};
  const does = keys[event.key.toLowerCase()];  // after Caps Lock, too
  if (does) { does(); event.preventDefault(); }
});
document.getElementById('success').onclick = () => label(true);
document.getElementById('failure').onclick = () => label(false);
document.getElementById('back').onclick = () => move(-1);
document.getElementById('on').onclick = () => move(1);
document.getElementById('save').onclick = () => {
  merge();
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([JSON.stringify({page: document.body.dataset.page, labels}, null, 1)]));
  link.download = 'labels.json';
  link.click();
  unsaved = false;
  show();
};
addEventListener('beforeunload', (event) => { if (unsaved) event.preventDefault(); });
merge();
show();
"""

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 34rem; margin: 2rem auto; padding: 0 1rem; }
img { width: 100%; max-width: 24rem; image-rendering: pixelated; display: block; } img[hidden] { display: none; }
button { font: inherit; padding: .5rem 1rem; margin: .6rem .4rem 0 0; }
"""


def choose(judged: Judgement, clips: int, seed: int = 0) -> list[tuple[str, str, int]]:
    """(policy, world, start) of `clips` episodes, drawn from all of the true world, if there is one, and the learned
    one, shuffled."""
    worlds = [world for world in (TRUE, LEARNED) if world in judged.worlds]
    every = [(p, w, m) for p in judged.policies for w in worlds for m in range(judged.config.starts)]
    drawn = np.random.default_rng([seed, 15]).permutation(len(every))[:clips]
    return [every[i] for i in drawn]


def write_blind(judged: Judgement, out: Path, clips: int = 60) -> Path:
    """Writes OUT/blind.html, with clips identified only by number. OUT/blind.json says which number is which
    episode."""
    chosen, pictures = choose(judged, clips), []
    for number, (policy, world, start) in enumerate(chosen):
        film = judged.rollouts(policy, world).images[start]
        pictures.append(f'<img hidden alt="clip {number}" data-clip="{number}" src="{data_uri(_film(film), "webp")}">')
    drawn = hashlib.sha256("".join(pictures).encode()).hexdigest()[:12]  # labels belong to these clips and no others
    page = f"{judged.config.task.robot}-{judged.config.task.name}-{judged.config.seed}-{clips}-{drawn}"
    content = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width, initial-scale=1"><title>Success or not?</title>'
        f'<style>{STYLE}</style></head><body data-page="{page}">'
        f"<h1>Is the task done?</h1><p>The goal: {html.escape(judged.config.task.goal)}, for "
        f"{judged.config.task.hold} consecutive frames at any time. Keys: S success, F failure, arrow keys previous and next clip.</p>"
        f"{''.join(pictures)}<p id=where></p><button id=success>success</button><button id=failure>failure</button>"
        "<button id=back>previous</button><button id=on>next</button><button id=save>save labels.json</button>"
        f"<script>{SCRIPT}</script></body></html>\n"
    )
    write_file(out / "blind.json", json.dumps({"page": page, "clips": chosen}) + "\n")
    write_file(out / "blind.html", content)
    return out / "blind.html"


def _film(images: np.ndarray) -> bytes:
    frames = [Image.fromarray(image) for image in images]
    larger = [f.resize((ENLARGED * f.width, ENLARGED * f.height), Image.Resampling.NEAREST) for f in frames]
    return animation(larger, [SHOW_MS] * (len(larger) - 1) + [HOLD_MS], quality=70, method=2)


def read_labels(path: Path, out: Path) -> dict[tuple[str, str, int], bool]:
    """{(policy, world, start): whether a person calls it a success}. Raises ConfigError for labels of another page."""
    require(
        (out / "blind.json").is_file(),
        f"{out} holds no results of `hma judge` (no blind.json); give the --out of the command that evaluated the policies",
    )
    require(path.is_file(), f"{path}: no such file; give the file that the page {out / 'blind.html'} saved")
    try:
        saved: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        key: dict[str, Any] = json.loads((out / "blind.json").read_text())
        labels = {int(number): bool(value) for number, value in saved["labels"].items()}
        clips: Sequence[Any] = key["clips"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} cannot be read as labels of {out / 'blind.html'} ({error})") from error
    require(
        saved.get("page") == key["page"], f"{path} has labels of another page ({saved.get('page')}, not {key['page']})"
    )
    require(
        bool(labels) and all(0 <= n < len(clips) for n in labels),
        f"{path} has labels of clips that are not on the page, or no labels",
    )
    return {(clips[n][0], clips[n][1], int(clips[n][2])): value for n, value in labels.items()}


def compare_labels(labels: dict[tuple[str, str, int], bool], outcomes: Sequence[Outcome]) -> dict[str, Interval]:
    """How often a person and a judge agree: with the head in each world, with the state in the true one."""
    judged = {(o.policy, o.world, o.start, o.judge): o.success for o in outcomes}
    rates = {}
    for world, judge in ((LEARNED, HEAD), (TRUE, HEAD), (TRUE, STATE)):
        agreements = [judged[p, w, m, judge] == label for (p, w, m), label in labels.items() if w == world]
        if agreements:
            rates[f"{judge}, {world} world"] = rate_interval(np.array(agreements))
    return rates
