"""Drives the page of a run in a real Chromium and checks what its readers rely on.

Called by `report_page.rs`; by hand: python tests/report_page.py REPORT --screenshots FOLDER
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import axe_playwright_python
from browser import (
    BROWSER_ARGUMENTS,
    HEIGHT,
    Report,
    find_browser,
    frames,
    number,
    step_of,
    wait_for,
)
from playwright.sync_api import Error, sync_playwright

AXE = Path(axe_playwright_python.__file__).parent / "axe.min.js"
WIDTHS = [390, 768, 1024, 1440, 2000]


def opens_on_a_pair_that_the_verifier_won(report: Report) -> None:
    with report.page() as page:
        assert page.locator("#verdict.won").count() == 1, page.inner_text("#pair-line")
        wait_for(
            page,
            "[...document.querySelectorAll('.stage video')].every((video) => video.readyState >= 2)",
        )
        wait_for(
            page,
            "[...document.querySelectorAll('.stage video')].every((v) => !v.seeking)",
        )
        assert frames(page) == [step_of(page)] * 2, "both videos show the step"
        assert page.locator("#cards .card").count() == 5
        assert page.locator("#cards .executed[aria-pressed=true]").count() == 1
        assert page.locator("#left .overlay rect.source").count() == 1
        box = page.locator("#left .stage").bounding_box()
        assert box is not None and box["y"] + box["height"] < HEIGHT, (
            "both images are in view"
        )


def says_why_the_candidate_was_chosen(report: Report) -> None:
    with report.page() as page:
        terms = page.locator("#why .terms tbody tr:not(.sum) .number").all_inner_texts()
        assert len(terms) >= 3, page.inner_text("#why")
        total = number(page.inner_text("#why .terms .sum .number"))
        assert abs(sum(map(number, terms)) - total) < 0.06, (
            f"{terms} are the terms of {total}"
        )
        shown = page.locator("#cards .card-score strong").all_inner_texts()
        values = [number(text) for text in shown]
        assert abs(sum(values)) < 0.06, f"{values} are relative to their mean"
        executed = number(page.inner_text("#cards .executed .card-score strong"))
        assert executed == max(values) and abs(executed - total) < 0.011


def plays_both_videos_together(report: Report) -> None:
    with report.page() as page:
        page.keyboard.press("Tab")
        page.focus("#left .stage")
        page.keyboard.press("Home")
        assert step_of(page) == 0
        page.keyboard.press(" ")
        wait_for(page, "Number(document.querySelector('#scrubber').value) >= 8")
        apart = page.evaluate(
            "(([a, b]) => Math.abs(a.currentTime - b.currentTime))"
            "([...document.querySelectorAll('.stage video')])"
        )
        assert apart < 0.5, f"the videos are {apart} s apart"
        page.keyboard.press(" ")
        assert page.inner_text("#play") == "Play"
        wait_for(
            page,
            "[...document.querySelectorAll('.stage video')].every((v) => !v.seeking)",
        )
        step = step_of(page)
        assert frames(page) == [step, step], f"{frames(page)} at step {step}"
        page.keyboard.press("ArrowRight")
        assert step_of(page) == step + 1
        page.keyboard.press("End")
        assert "end of" in page.inner_text("#step-number")
        page.click("#play")
        wait_for(page, "Number(document.querySelector('#scrubber').value) >= 1")
        page.click("#play")


def steps_through_candidates(report: Report) -> None:
    with report.page() as page:
        page.focus("#left .stage")
        seen = set()
        for index in range(5):
            page.keyboard.press(str(index + 1))
            pressed = page.locator("#cards [aria-pressed=true]")
            assert (
                pressed.count() == 1
                and f"Candidate {index + 1}" in pressed.inner_text()
            )
            assert f"candidate {index + 1}" in page.inner_text("#why h3")
            seen.add(page.inner_text("#said"))
        assert len(seen) == 5
        page.click("#cards .card:nth-child(3)")
        focused = page.evaluate("document.activeElement.dataset.key")
        assert focused == "card-2", f"the focus stays on the card, got {focused}"


def filters_searches_and_sorts(report: Report) -> None:
    pairs = report.catalogue["pairs"]
    with report.page() as page:
        rows = page.locator("#rows .row")
        assert rows.count() == min(len(pairs), 200)
        for result in ["won", "lost", "both", "neither"]:
            page.select_option("#filter-result", result)
            expected = [pair for pair in pairs if report.result(pair) == result]
            assert rows.count() == len(expected), result
            assert page.inner_text("#count").startswith(
                f"{len(expected)} of {len(pairs)}"
            )
        page.select_option("#filter-result", "faults")
        expected = [
            p for p in pairs if any(entry.get("faults") for entry in p["episodes"])
        ]
        assert rows.count() == len(expected)
        page.select_option("#filter-result", "")
        page.select_option("#filter-task", "0")
        assert rows.count() == sum(pair["task"] == 0 for pair in pairs)
        page.select_option("#filter-task", "")
        page.fill("#search", report.catalogue["tasks"][-1])
        assert rows.count() == sum(
            p["task"] == len(report.catalogue["tasks"]) - 1 for p in pairs
        )
        page.fill("#search", "nothing has this name")
        assert rows.count() == 0
        page.fill("#search", "")
        page.select_option("#sort", "high")
        left = report.catalogue["compared"][0]
        scores = [
            entry["score"]
            for p in pairs
            for entry in p["episodes"]
            if entry["setting"] == left
        ]
        best = max(range(len(pairs)), key=lambda index: scores[index])
        assert rows.first.get_attribute("data-key") == str(best)


def shows_one_setting_alone(report: Report) -> None:
    with report.page() as page:
        page.select_option("#right select", "")
        wait_for(page, "document.querySelector('#right').hidden")
        assert (
            page.inner_text("#verdict") == ""
            and page.locator("#cards .card").count() == 5
        )
        assert "with=" not in page.url
        left = report.catalogue["compared"][0]
        outcomes = [e["outcome"] for e in report.episodes_of(left)]
        page.select_option("#filter-result", "outcome-success")
        assert page.locator("#rows .row").count() == outcomes.count("success")
        page.click("#beside")
        wait_for(page, "!document.querySelector('#right').hidden")


def everything_works_by_keyboard(report: Report) -> None:
    with report.page() as page:
        page.keyboard.press(" ")
        assert page.inner_text("#play") == "Play", (
            "a key outside the viewer plays nothing"
        )
        reached = []
        for _ in range(80):
            page.keyboard.press("Tab")
            reached.append(
                page.evaluate(
                    "(() => { const it = document.activeElement; const style = getComputedStyle(it);"
                    " return [it.id || it.className.baseVal || it.className || it.tagName,"
                    " style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) >= 2]; })()"
                )
            )
        names = [str(name) for name, _ in reached]
        for wanted in [
            "stage",
            "play",
            "scrubber",
            "search",
            "filter-result",
            "row",
            "copy-link",
        ]:
            assert wanted in names, f"{wanted} is reached by Tab: {names}"
        assert any(name.startswith("card") for name in names), names
        invisible = [
            name for name, is_visible in reached if not is_visible and name != "BODY"
        ]
        assert not invisible, f"no focus to be seen on {invisible}"
        page.focus("#help summary")
        page.keyboard.press(" ")
        assert page.locator("#help[open]").count() == 1, (
            "space opens what has the focus"
        )
        assert page.inner_text("#play") == "Play"
        page.focus("#rows .row[tabindex='0']")
        page.keyboard.press("Home")
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Enter")
        current = page.locator("#rows .row[aria-current]")
        assert current.get_attribute("data-key") == "1"
        assert page.evaluate("document.activeElement.dataset.key") == "1", (
            "the focus stays"
        )
        page.focus("#left select")
        page.select_option("#left select", str(report.catalogue["compared"][1]))
        assert page.evaluate("document.activeElement.tagName") == "SELECT"


def links_lead_to_an_episode_and_a_step(report: Report) -> None:
    left = report.catalogue["compared"][0]
    ids = [e["id"] for e in report.episodes_of(left)]
    for width in [390, 1440]:
        with report.page(f"#episode={ids[-1]}&step=12", width=width) as page:
            wait_for(page, "document.querySelector('#scrubber').value === '12'")
            box = page.locator("#left .stage").bounding_box()
            assert box is not None and 0 <= box["y"] < HEIGHT / 2, (
                f"scrolled to it, at {box}"
            )
            page.evaluate(f"location.hash = '#episode={ids[0]}&step=7'")
            wait_for(page, "document.querySelector('#scrubber').value === '7'")
            page.evaluate(f"location.hash = '#episode={ids[1]}&step=NaN'")
            wait_for(
                page,
                f"location.hash.includes({json.dumps(ids[1])}) && !/NaN/.test(location.hash)",
            )
            assert "NaN" not in page.inner_text("#step-number")
            page.click("nav a[href='#result']")
            assert f"episode={ids[1]}" in page.url, "the link keeps its episode"
            top = page.locator("#result").bounding_box()
            assert top is not None and abs(top["y"]) < 60, (
                f"scrolled to the section, at {top}"
            )


def has_no_serious_barrier(report: Report) -> None:
    for scheme in ["light", "dark"]:
        for width in [390, 1440]:
            with report.page(width=width, color_scheme=scheme) as page:
                page.evaluate(
                    "document.querySelectorAll('details').forEach((one) => (one.open = true))"
                )
                page.evaluate(AXE.read_text(encoding="utf-8"))
                found = page.evaluate("axe.run({ preload: false })")
                serious = [
                    f"{one['id']}: {[node['target'] for node in one['nodes'][:5]]}"
                    for one in found["violations"]
                    if one["impact"] in ("serious", "critical")
                ]
                assert not serious, f"{scheme}, {width} px: {serious}"
                assert len(found["passes"]) > 15, "axe has looked at the page"


def fits_every_width(report: Report) -> None:
    for width in WIDTHS:
        with report.page(width=width) as page:
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width, f"{wide} px on a window of {width} px"
            cut = page.evaluate(
                "[...document.querySelectorAll('figure, table, #cards, .card, #why, .side-head, #controls')]"
                ".filter((one) => one.scrollWidth > one.clientWidth + 1 && one.clientWidth > 0)"
                ".map((one) => one.id || one.className || one.tagName)"
            )
            assert not cut, f"{width} px cut off {cut}"
            small = page.evaluate(
                "[...document.querySelectorAll('figure svg')].filter((svg) => svg.clientWidth > 0)"
                ".map((svg) => 12 * svg.clientWidth / svg.viewBox.baseVal.width)"
            )
            assert small and min(small) >= 9.5, (
                f"{width} px: figures with text of {small} px"
            )


def gives_figures_as_files(report: Report) -> None:
    with report.page() as page:
        for kind, start in [("CSV", "setting,"), ("SVG", "<svg")]:
            with page.expect_download() as waiting:
                page.click(f"figure[data-name=paired-gains] button:has-text('{kind}')")
            text = Path(waiting.value.path()).read_text(encoding="utf-8")
            assert text.startswith(start), text[:80]
            assert waiting.value.suggested_filename.endswith(
                f"paired-gains.{kind.lower()}"
            )
        page.locator("[data-name=rates] .term").first.focus()
        tip = page.locator("#tip")
        assert tip.is_visible() and len(tip.inner_text()) > 20
        page.keyboard.press("Escape")
        assert tip.is_hidden()
        assert "rever " in page.inner_text(".command code")


def is_readable_on_paper_and_without_scripts(report: Report) -> None:
    with report.page() as page:
        page.emulate_media(media="print")
        assert (
            page.locator("#episodes").is_hidden()
            and page.locator("#result").is_visible()
        )
    with report.page(java_script_enabled=False) as page:
        assert "needs JavaScript" in page.inner_text("#episodes")
        assert (
            page.locator("#viewer").is_hidden()
            and page.locator("#result table").first.is_visible()
        )


CHECKS: list[Callable[[Report], None]] = [
    opens_on_a_pair_that_the_verifier_won,
    says_why_the_candidate_was_chosen,
    plays_both_videos_together,
    steps_through_candidates,
    filters_searches_and_sorts,
    shows_one_setting_alone,
    everything_works_by_keyboard,
    links_lead_to_an_episode_and_a_step,
    has_no_serious_barrier,
    fits_every_width,
    gives_figures_as_files,
    is_readable_on_paper_and_without_scripts,
]


def keep_screenshots(report: Report, folder: Path) -> None:
    """One image of the whole page, and one of its first screen, for each width and colour scheme."""
    folder.mkdir(parents=True, exist_ok=True)
    for width in [390, 1024, 1440, 2000]:
        for scheme in ["light", "dark"]:
            with report.page(width=width, color_scheme=scheme) as page:
                wait_for(
                    page,
                    "[...document.querySelectorAll('.stage video')].every((v) => !v.seeking)",
                )
                page.screenshot(path=folder / f"{width}-{scheme}-first.png")
                page.screenshot(path=folder / f"{width}-{scheme}.png", full_page=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", type=Path, help="the report's folder")
    parser.add_argument("--screenshots", type=Path, help="folder for screenshots")
    parser.add_argument("--only", help="run the checks whose name holds this")
    arguments = parser.parse_args()
    failed = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=find_browser(), args=BROWSER_ARGUMENTS, headless=True
        )
        report = Report(browser, arguments.report)
        print(f"Chromium {browser.version}")
        if arguments.screenshots is not None:
            keep_screenshots(report, arguments.screenshots)
        for check in CHECKS:
            name = check.__name__.replace("_", " ")
            if arguments.only is not None and arguments.only not in name:
                continue
            try:
                check(report)
                print(f"ok    {name}")
            except (AssertionError, Error) as error:
                failed.append(name)
                print(f"FAULT {name}: {type(error).__name__} {error}")
        browser.close()
    sys.exit(f"{len(failed)} checks failed" if failed else 0)


if __name__ == "__main__":
    main()
