"""JSON files whose changes show line by line."""

from __future__ import annotations

import json

from trackwright.trackers.recordings.files import atomic_write, json_text

LINE = 1000  # most characters of a line that holds a whole list or row


def write_json(out, results) -> None:
    """Write the results, a row a line, creating the folder if missing."""
    out.parent.mkdir(parents=True, exist_ok=True)
    text = compact(json.loads(json_text(results)), top=True)
    atomic_write(out, lambda path: path.write_text(f"{text}\n", "utf-8"))


def compact(value, indent="", top=False):
    """JSON in which a row has a line, and so has every other value that fits into one."""
    line, deeper = json.dumps(value, ensure_ascii=False), indent + "  "
    if not value or not isinstance(value, dict | list):
        return line
    if isinstance(value, dict):
        each = [f"{json.dumps(k, ensure_ascii=False)}: {compact(v, deeper)}" for k, v in value.items()]
    else:
        each = [compact(v, deeper) for v in value]
    rows = isinstance(value, list) and isinstance(value[0], dict)
    if not (top or rows or len(indent) + len(line) > LINE or any("\n" in part for part in each)):
        return line
    begin, end = "{}" if isinstance(value, dict) else "[]"
    return f"{begin}\n{deeper}" + f",\n{deeper}".join(each) + f"\n{indent}{end}"
