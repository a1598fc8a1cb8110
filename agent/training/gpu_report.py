"""Collects the figures of gpu_check.sh in one report: report.json and report.md.

python agent/training/gpu_report.py FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    folder = Path(sys.argv[1])
    report = collect(folder)
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    text = markdown(report)
    (folder / "report.md").write_text(text, encoding="utf-8")
    print(text)


def collect(folder: Path) -> dict[str, Any]:
    """All JSON files of the check, by name; the GPU's lines."""
    parity = sorted(folder.glob("parity-*.json"))
    return {
        "gpu": (folder / "gpu.txt").read_text(encoding="utf-8").splitlines(),
        "parity": {file.stem.removeprefix("parity-"): read(file) for file in parity},
        "decision": read(folder / "decision.json"),
        "throughput": read(folder / "throughput.json"),
    }


def read(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))


def markdown(report: dict[str, Any]) -> str:
    """Three tables: agreement, one decision, batches."""
    lines = ["# Check of a GPU", "", *report["gpu"], f"commit {report['decision']['commit']}", ""]
    lines += ["| checkpoint and device | agrees | largest difference / deviation of logits |"]
    lines += ["|---|---|---|"]
    for name, figures in report["parity"].items():
        worst = max(row["logits_difference"] / row["logits_deviation"] for row in figures["rows"])
        lines.append(f"| {name} | {'yes' if figures['agrees'] else 'NO'} | {worst:.1e} |")
    lines += ["", "| candidates | temperature | prefill ms | token step ms | decision ms |"]
    lines += ["|---|---|---|---|---|"]
    for row in report["decision"]["rows"]:
        setting = row["setting"]
        lines.append(
            f"| {setting['candidates']} | {setting['temperature']} | {row['prefill_ms']:.1f}"
            f" | {row['step_ms']:.2f} | {row['decision_ms_p50']:.1f} |"
        )
    lines += ["", "| concurrent episodes | decisions/s | MB |", "|---|---|---|"]
    for row in report["throughput"]["rows"]:
        rate, memory = row["decisions_per_second"], row["memory_mb_after"]
        lines.append(f"| {row['sessions']} | {rate:.2f} | {memory:.0f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
