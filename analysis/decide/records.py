"""What was decided in a store, read without anything that trains."""

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records.files import read_json

FOLDER = ".decisions"
"""In a store: a record a question."""


def records(store: str | Path) -> pd.DataFrame:
    """The records of a store: what ended or was compared last in each scene, and the question that it belongs to."""
    tables, known, times = [], [], dict[str, str]()  # run -> when the first record that has it was registered
    for path in sorted(Path(store).glob(f"{FOLDER}/*.json")):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # a damaged record is left out
            found = read_json(path)
            time = found["registered"]["time"]
            times |= {run: min(time, times.get(run, time)) for run in itertools.chain(*found["runs"].values())}
            known.append(found)
    for found in known:
        with contextlib.suppress(ValueError, KeyError, TypeError):
            looks = pd.DataFrame([*found["looks"], *unseen(found)])
            last = looks[looks["ended"] | (looks["seeds"] == looks.groupby("scene")["seeds"].transform("max"))]
            asked = {key: found["question"][key] for key in ("within", "metric", "equal", "common")}
            asked["about"] = found["question"]["candidates"][0]
            steps = ", ".join(f"{name} {count}" for name, count in found["steps"].items())
            changes = [f"budget {change['budget']:g} s at {change['time']}" for change in found["changes"]]
            if earlier := sum(found["earlier"].values()):
                count = sum(map(len, found["runs"].values()))
                changes.append(f"{earlier} of {count} judged runs are older than the record")
            time, budget = found["registered"]["time"], found["registered"]["budget"]
            ids = itertools.chain(*found["runs"].values())
            if shared := sum(times[run] < time for run in ids):
                changes.append(f"{shared} judged runs stand in an earlier record, too")
            study = {"registered": f"{time}, budget {budget:g} s", "changes": "; ".join(changes)}
            how = [searched(found["tuned"], look) for look in last.to_dict("records")]
            study["spaces"] = [spaces(found["spaces"], look) for look in last.to_dict("records")]
            for_all = [word for word in asked["common"].split() if word.startswith(("scene=", "scene."))]
            last = last.replace({"scene": {"": name_of(" ".join(for_all))}})
            names = names_of(found["question"]["candidates"])
            if any(name != text for text, name in names.items()):
                asked["candidates"] = "; ".join(names)
                last, asked["about"] = last.replace({"baseline": names, "candidate": names}), names[asked["about"]]
            tables.append(last.assign(**asked, most=found["most"], steps=steps, **study, searched=how))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def unseen(record: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """A row for each candidate of a scene at which nobody has looked yet."""
    question = record["question"]
    known = {look["scene"] for look in record["looks"]}
    baseline, *others = question["candidates"]
    for scene in question["scenes"]:
        if name_of(scene) not in known:
            own = [title(scene, name) for name in question["candidates"]]
            done = sum(name in record["tuned"] for name in own)
            verdict = f"no look yet; {done} of {len(own)} searched" if question["tune"] else "no look yet"
            for name in others:
                row = {"scene": name_of(scene), "seeds": 0, "baseline": baseline, "candidate": name}
                yield row | {"verdict": verdict, "ended": False}


def name_of(scene: str) -> str:
    """The name of a scene by its overrides: its folder's or, without one, its kind."""
    values = dict(part.partition("=")[::2] for part in scene.split())
    return Path(values.get("scene.path") or values.get("scene", scene)).name


def names_of(candidates: Sequence[str]) -> dict[str, str]:
    """Candidate -> what verdicts call it: of commands the words in which they differ, with the option before them.

    >>> names_of(["python train.py --model a --fast", "python train.py --model b --fast"])
    {'python train.py --model a --fast': '--model a', 'python train.py --model b --fast': '--model b'}
    """
    words = [text.split() for text in candidates]
    if not any(map(is_command, words)):
        return {text: text for text in candidates}
    shortest = min(map(len, words)) - 1  # a word is left of each
    columns, backwards = zip(*words, strict=False), zip(*(own[::-1] for own in words), strict=False)
    same = lambda column: len(set(column)) == 1  # noqa: E731
    start = min(shortest, sum(1 for _ in itertools.takewhile(same, columns)))
    end = min(shortest - start, sum(1 for _ in itertools.takewhile(same, backwards)))
    if start and words[0][start - 1].startswith("-"):
        start -= 1
    return {text: " ".join(own[start : len(own) - end]) for text, own in zip(candidates, words, strict=True)}


def is_command(words: Sequence[str]) -> bool:
    """Overrides have the form KEY=VALUE or ~KEY; any other word belongs to a command."""
    return any("=" not in word and word[0] != "~" for word in words)


def title(scene: str, candidate: str) -> str:
    return f"{name_of(scene)}: {candidate}" if scene else candidate


def searched(tuned: Mapping[str, Mapping[str, Any]], look: Mapping[Any, Any]) -> str:
    """What a search chose for the two candidates of a look, after how many trials, and what it cost."""
    texts = []
    for candidate in (look["baseline"], look["candidate"]):
        if one := tuned.get(f"{look['scene']}: {candidate}", tuned.get(candidate)):
            chosen, best = ", ".join(one["chosen"]) or "its own options", one["expected"]
            cost = f"{one['trials']} trials, {one['seconds'] / 60:.1f} minutes"
            gain = f"expected best {best[0]:.4g} of 1, {best[-1]:.4g} of {len(best)}"
            unseen = f", {one['validation'].partition(':')[0]}" if isinstance(one["validation"], str) else ""
            texts.append(f"{candidate}: {chosen} ({cost}, {gain}{unseen})")
    return "; ".join(texts)


def spaces(known: Mapping[str, Mapping[str, str]], look: Mapping[Any, Any]) -> str:
    """The values from which a search could choose for the two candidates of a look."""
    texts = []
    for candidate in (look["baseline"], look["candidate"]):
        own = known.get(f"{look['scene']}: {candidate}", known.get(candidate, {}))
        texts += [f"{candidate}: {', '.join(f'{option}={values}' for option, values in own.items())}"] if own else []
    return "; ".join(texts)
