"""`labapp session info`: contents and state of a session, as text or JSON."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labapp.cli.shared import SessionFile, frames_text
from labapp.errors import printable
from labapp.text import pluralize

if TYPE_CHECKING:
    from labapp.session.session import Session

NOT_MEASURED = "not measured"


def info(
    file: SessionFile,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for programs.")] = False,
    history: Annotated[
        bool, typer.Option("--history", help="Also list the changes that can be undone or redone.")
    ] = False,
) -> None:
    """Show the contents of a session, even while another program writes to it."""
    from labapp.session.session import Session

    with Session.open(file, read_only=True) as session:
        facts = _facts(session)
        if history:
            facts["history"] = [
                {"number": c.number, "label": c.label, "made": c.made, "undone": c.undone}
                for c in session.history
            ]
    if as_json:
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        typer.echo("\n".join(_text(facts)))


def _facts(session: Session) -> dict[str, Any]:
    """Return all facts about a session as plain values."""
    from labapp.core.pipeline import Settings
    from labapp.session.record import Record
    from labapp.session.results.measured import scheme_name

    seen, recording = session.overview(), session.recording
    laser, plane = session.laser_calibration, session.plane_calibration
    check = session.bench_check
    entered = {
        "laser readings": session.laser_entries,
        "imaging-plane points": session.plane_entries,
        "bench-check pictures": session.bench_entries,
    }
    statuses = Counter(status or NOT_MEASURED for status in seen.status)
    missing = session.missing_recording
    return {
        "file": str(session.path),
        "size_bytes": session.path.stat().st_size,
        "record": _differences(session.record, Record()),
        "recording": None
        if recording is None
        else {name: value for name, value in asdict(recording).items() if name != "index"}
        | {"missing": None if missing is None else str(missing)},
        "setup_lacks": [
            f"{p.field}: {p.value}; expected {p.expected}" for p in session.setup_problems
        ],
        "laser_calibration": None
        if laser is None
        else {
            "projection_angle_deg": laser.found.angle_deg,
            "projection_angle_sigma_deg": laser.found.angle_sigma_deg,
            "distance_mm": laser.found.distance_mm,
            "distance_sigma_mm": laser.found.distance_sigma_mm,
        },
        "plane_calibration": None
        if plane is None
        else {"unit_mm": plane.unit_mm, "px_per_mm": list(plane.found.px_per_mm)},
        "bench_check": None
        if check is None
        else {
            "date": check.date,
            "mirrors": [one.kind for one in check.pictures],
            "in_use": not session.setup_problems and bool(session.setup.check_date),
        },
        "not_applied": [name for name, entries in entered.items() if entries is not None],
        "settings": _differences(session.settings, Settings()),
        "scheme": scheme_name(session.settings),
        "frames": len(seen.frame),
        "statuses": dict(statuses),
        "corrected": seen.frame[seen.corrected].tolist(),
        "stale": seen.frame[seen.stale].tolist(),
        "results": [
            {"scheme": scheme, "version": version, "count": count}
            for (scheme, version), count in session.measured_by.items()
        ],
        "changes": {
            "undoable": sum(not change.undone for change in session.history),
            "redoable": sum(change.undone for change in session.history),
        },
    }


def _differences(value: Any, usual: Any) -> dict[str, Any]:
    """Return the fields that differ from ``usual``, full name → value."""
    from labapp.config.settings import differences

    return {name: mine for name, (mine, _) in differences(value, usual).items()}


def _text(facts: dict[str, Any]) -> list[str]:
    results = [f"{r['count']} {r['scheme']} by labapp {r['version']}" for r in facts["results"]]
    changes = facts["changes"]
    lines = [
        ("session", f"{facts['file']} ({facts['size_bytes'] / 1e6:.1f} MB)"),
        ("record", _listed(facts["record"]) or "empty"),
        *_recording_lines(facts["recording"]),
        *(
            ("set-up" * (not k), text)
            for k, text in enumerate(facts["setup_lacks"] or ["complete"])
        ),
        *_calibration_lines(facts),
        ("settings", _listed(facts["settings"]) or "all as usual"),
        ("frames", f"{facts['frames']}: {_counts(facts['statuses'])} ({facts['scheme']})"),
        ("corrected", frames_text(facts["corrected"])),
        ("stale", frames_text(facts["stale"])),
        ("results", ", ".join(results) or "none"),
        ("changes", f"{changes['undoable']} to undo, {changes['redoable']} to redo"),
    ]
    lines += [
        ("", f"{c['made']}  {c['label']}{' (undone)' * c['undone']}")
        for c in facts.get("history", ())
    ]
    return [printable(f"{name:11}{text}") for name, text in lines]


def _recording_lines(recording: dict[str, Any] | None) -> list[tuple[str, str]]:
    from labapp.media.base import format_frame_rate

    if recording is None:
        return [("recording", "none imported yet")]
    where = "in the session itself" if recording["embedded"] else recording["path"]
    rate = recording["frame_rate_hz"]
    start, stop, step = recording["selected"]
    lines = [
        ("recording", f"{where}: {recording['description']}"),
        (
            "",
            f"{pluralize(recording['frames'], 'frame')}, of which {start}:{stop}:{step}; "
            f"{'no time base' if rate is None else format_frame_rate(rate)}; "
            f"{'' if recording['frame_exact'] else 'not '}frame-exact",
        ),
        *(("", f"warning: {warning}") for warning in recording["warnings"]),
    ]
    if recording["missing"]:
        remedy = "is missing; labapp session relink sets its new path"
        lines.append(("", f"{recording['missing']} {remedy}"))
    return lines


def _calibration_lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    lines = []
    if laser := facts["laser_calibration"]:
        angle = f"{laser['projection_angle_deg']:.3f} ± {laser['projection_angle_sigma_deg']:.3f}"
        distance = f"{laser['distance_mm']:.3f} ± {laser['distance_sigma_mm']:.3f}"
        lines.append(("laser", f"{angle} degrees, {distance} mm"))
    if plane := facts["plane_calibration"]:
        x, z = plane["px_per_mm"]
        lines.append(("plane", f"{x:.4f} px/mm along X′, {z:.4f} px/mm along Z′"))
    if check := facts["bench_check"]:
        now = "in use" if check["in_use"] else "the set-up was changed since"
        lines.append(("checked", f"{check['date'][:10]}, {', '.join(check['mirrors'])}; {now}"))
    if entered := facts["not_applied"]:
        lines.append(("waiting", f"{', '.join(entered)}: not applied yet"))
    return lines


def _listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())


def _counts(statuses: dict[str, int]) -> str:
    return ", ".join(f"{count} {status}" for status, count in statuses.items()) or "none"
