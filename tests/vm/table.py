"""Results as Markdown; `tests/results/make faults` keeps those of the full form."""

HEAD = ["scenario", "what was done", "what was published (state, error bits)", "widest gap of health s", "recovery s", "note"]


def cell(value):
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.2f}"
    return str(value).replace("|", "/").replace("\n", " ").strip()


def markdown(records, about):
    """One line for each row that a scenario reported; a failed scenario has its reason."""
    passed = sum(r["passed"] for r in records)
    clock = ("emulated; its clock counts instructions, one a nanosecond" if about["accelerator"] == "tcg" else "by KVM")
    lines = [f"{about['version']}, {about['form']} form, release build, in a Debian guest with systemd and one processor ({clock}). "
             f"{passed} of {len(records)} scenarios passed, {about['minutes']:.0f} minutes.",
             "Times are the guest's. Recovery: from the return of what was missing to frames (or, where said, poses) again.", "",
             "| " + " | ".join(HEAD) + " |", "|---|---|---|---:|---:|---|"]
    for record in records:
        if not record["passed"]:
            lines.append(f"| {record['scenario']} | **failed** | {cell(record['reason'].strip().splitlines()[-1])} | | | |")
            continue
        for row in record["rows"]:
            values = [record["scenario"], row["done"], row.get("published"), row.get("widest_gap_s"), row.get("recovery_s"),
                      row.get("note", "")]
            lines.append("| " + " | ".join(map(cell, values)) + " |")
    return "\n".join(lines) + "\n"
