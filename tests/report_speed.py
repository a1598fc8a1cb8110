"""Measures how fast the page of a run with many episodes opens and filters, in a real Chromium.

The catalogue of a real report is repeated until it has as many episodes; everything else stays as it is:
python tests/report_speed.py REPORT --episodes 10000
"""

import argparse
import json
import shutil
import statistics
import tempfile
from pathlib import Path

from browser import BROWSER_ARGUMENTS, find_browser
from playwright.sync_api import Page, sync_playwright

BEFORE, AFTER = "window.reverCatalogue = ", ";\n"
REPEATS = 5
# From the event to the next frame that is drawn, layout included.
TIMED = """([id, value, kind]) => new Promise((resolve) => {
  const control = document.getElementById(id);
  control.value = value;
  const start = performance.now();
  control.dispatchEvent(new Event(kind));
  document.body.offsetHeight;
  const computed = performance.now() - start;
  requestAnimationFrame(() => setTimeout(() => resolve([computed, performance.now() - start])));
})"""


def enlarge(report: Path, episodes: int) -> int:
    """Repeats the pairs of the catalogue; the number of episodes that it has then."""
    path = report / "data" / "catalogue.js"
    catalogue = json.loads(
        path.read_text(encoding="utf-8").removeprefix(BEFORE).removesuffix(AFTER)
    )
    originals, pairs, count = catalogue["pairs"], [], 0
    while count < episodes:
        original = originals[len(pairs) % len(originals)]
        copy = len(pairs) // len(originals)
        pair = json.loads(json.dumps(original))
        pair["layout"] = f"random {len(pairs)}"
        if copy > 0:
            for entry in pair["episodes"]:
                entry["id"] += f"-copy{copy}"
                entry.pop("detail", None)
                entry.pop("video", None)
        pairs.append(pair)
        count += len(pair["episodes"])
    catalogue["pairs"] = pairs
    path.write_text(
        BEFORE + json.dumps(catalogue, separators=(",", ":")) + AFTER, encoding="utf-8"
    )
    return count


def opened(page: Page, address: str) -> dict[str, float]:
    page.goto(address)
    page.wait_for_selector("#cards button")
    ready = page.evaluate("performance.now()")
    paint = page.evaluate(
        "performance.getEntriesByType('paint').map((one) => [one.name, one.startTime])"
    )
    return {**dict(paint), "viewer ready": ready}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", type=Path, help="the report's folder")
    parser.add_argument("--episodes", type=int, default=10_000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        report = Path(folder) / "report"
        shutil.copytree(arguments.report, report)
        count = enlarge(report, arguments.episodes)
        size = (report / "data" / "catalogue.js").stat().st_size
        browser = playwright.chromium.launch(
            executable_path=find_browser(), args=BROWSER_ARGUMENTS
        )
        print(
            f"Chromium {browser.version}, {count} episodes, catalogue of {size / 1e6:.1f} MB"
        )
        times: dict[str, list[float]] = {}
        for _ in range(REPEATS):
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            for name, value in opened(page, (report / "index.html").as_uri()).items():
                times.setdefault(name, []).append(value)
            for name, event in [
                ("filter by result", ["filter-result", "won", "change"]),
                ("filter off", ["filter-result", "", "change"]),
                ("search", ["search", "random 99", "input"]),
                ("search off", ["search", "", "input"]),
                ("sort by score", ["sort", "high", "change"]),
            ]:
                computed, drawn = page.evaluate(TIMED, event)
                times.setdefault(f"{name}, computed", []).append(computed)
                times.setdefault(f"{name}, drawn", []).append(drawn)
            page.close()
        browser.close()
    for name, values in times.items():
        print(
            f"{name:<28} median {statistics.median(values):7.1f} ms, largest {max(values):7.1f} ms"
        )


if __name__ == "__main__":
    main()
