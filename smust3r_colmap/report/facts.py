"""All that a report says, gathered from a finished run or from a model of another program.

What can be read is read (``summary.json``, the models, the verified matches); nothing in the folder changes. The next
module to read is ``page``, which draws it.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from smust3r_colmap import __version__
from smust3r_colmap.errors import InputError
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.colmap_model import read_colmap_model
from smust3r_colmap.importers.image_folder import natural_key
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.refinement.global_refinement import UNCERTAINTIES
from smust3r_colmap.refinement.model_uncertainty import (
    ModelUncertainty,
    UncertaintySummary,
    measure_uncertainty,
    summarise_uncertainty,
)
from smust3r_colmap.report.agreement import Agreement, agreement_of, count_matches, read_verified
from smust3r_colmap.report.measure import CameraFacts, Observed, camera_facts, observe
from smust3r_colmap.report.plan import RESULT, Path2D, earlier_path, plan_axes, read_centres
from smust3r_colmap.report.summarise import SEGMENTS_FILE, SUMMARY_FILE
from smust3r_colmap.report.summary import SCHEMA_VERSION
from smust3r_colmap.report.thumbnails import make_thumbnails
from smust3r_colmap.report.verdict import FAILED_PERCENT, MAX_REASONS, Level, Reason, Verdict, reasons_about
from smust3r_colmap.storage.run_directory import REFINED_STAGE, RunDirectory, read_json, storage_errors

SETTINGS_FILE = "config.toml"
GEO_FILE = "geo/geo.json"
FEATURES = Path("work/features/database.db")
MAX_THUMBNAILS = 400
MAX_CAMERAS = 4
"""Cameras that are shown with a residual grid."""
FEW_OBSERVATIONS = 15
"""Of an image of a model of another program; the limit of runs of ours, see ``refinement.statistics``."""
PACKAGES = ("pycolmap", "numpy", "scipy", "opencv-python-headless", "pillow", "torch")

STATES = (
    "registered",
    "few observations",
    "not determined by observations",
    "contradicted by most matches",
    "no pose",
    "unusable file",
)
"""Of an image, the worst last."""
REGISTERED, FEW, UNDETERMINED, CONTRADICTED, NO_POSE, UNUSABLE = range(len(STATES))


@dataclass(frozen=True, kw_only=True)
class ImageFacts:
    """One image.

    Args:
        name: as in the model. state: index of ``STATES``. note: the reason, or empty.
        model: folder of the model that has it, or empty.
        row: in the model that is shown, or None.
        num_observations, error_px, sigma_percent: NaN where there are none.
        thumbnail: JPEG data, or empty.
    """

    name: str
    state: int
    note: str
    model: str
    row: int | None
    num_observations: float
    error_px: float
    sigma_percent: float
    thumbnail: bytes


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFacts:
    """The model that is shown.

    Args:
        folder: for people. names: of its images by row.
        observed: its observations. cameras: those that are shown, of ``num_cameras``.
        uncertainty: of its poses; None if it has none.
        agreement: of the verified matches; None where none are known. agreement_note: where they are from, or why not.
        paths: before loops and before bundle adjustment, where they are known, and the final one. axes: of the plan.
        colour_of: by row, the number of the window or cluster; empty where they are not known.
    """

    folder: str
    names: tuple[str, ...]
    observed: Observed
    cameras: tuple[CameraFacts, ...]
    num_cameras: int
    uncertainty: ModelUncertainty | None
    agreement: Agreement | None
    agreement_note: str
    paths: tuple[Path2D, ...]
    axes: FloatArray
    colour_of: tuple[int, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportFacts:
    """A whole report.

    Args:
        what: what was reconstructed, for the title.
        verdict: its level and reasons. num_more_reasons: that are in the summary only.
        summary: what ``summary.json`` says, or what can be said of a model alone, in the same form.
        images: in natural order of their names. thumbnails_note: why some have no picture, or empty.
        model: the largest; None where none came out.
        geo: what ``geo/geo.json`` says; empty where the run was not georeferenced.
        products: files and folders beside the report.
        settings: the settings file, or empty.
        versions: of what wrote the report.
    """

    what: str
    verdict: Verdict
    num_more_reasons: int
    summary: Mapping[str, Any]
    images: tuple[ImageFacts, ...]
    thumbnails_note: str
    model: ModelFacts | None
    products: tuple[str, ...]
    settings: str
    versions: Mapping[str, str]
    geo: Mapping[str, Any] = field(default_factory=dict)


# ------------------------------------------------------------------------------- runs
def facts_of_run(root: Path, images: Path | None) -> ReportFacts:
    """Of a run that has written its results.

    Args:
        root: its folder. images: the folder of its images, or None.

    Raises:
        InputError: another version wrote the summary, or the folder has no model.
        StorageError: a file of the run cannot be read.
    """
    summary = read_json(root / SUMMARY_FILE)
    if not isinstance(summary, dict) or summary.get("schema_version") != SCHEMA_VERSION or "verdict" not in summary:
        raise InputError(
            f"{root / SUMMARY_FILE}: was written by another version of this program; start the run's command again, or "
            f"report {root / 'sparse/0'} as a model"
        )
    models = {one["folder"]: _read_model(root / one["folder"]) for one in summary["models"]}
    shown = next(iter(models))
    database, note = _database_of_run(root)
    settings = _text_of(root / SETTINGS_FILE)
    facts = _model_facts(
        shown,
        models[shown],
        database=database,
        note=note,
        calibrated=_is_calibrated(settings),
        stored=root / "work" / REFINED_STAGE,
        has_uncertainty=summary["models"][0]["uncertainty"] is not None,
    )
    facts = _with_paths(facts, root)
    reasons = tuple(Reason(**one) for one in summary["verdict"]["reasons"])
    return ReportFacts(
        what=f"{summary['num_images']} images",
        verdict=Verdict(level=summary["verdict"]["level"], reasons=reasons),
        num_more_reasons=len(summary["weak_reasons"]) - len(reasons),
        summary=summary,
        model=facts,
        geo=read_json(root / GEO_FILE) if (root / GEO_FILE).is_file() else {},
        products=_products(root),
        settings=settings,
        versions=_versions(),
        **_images(_states_of_run(summary), models, facts, images),
    )


def _states_of_run(summary: Mapping[str, Any]) -> dict[str, tuple[int, str]]:
    """State and note of the images that are not simply registered."""
    found: dict[str, tuple[int, str]] = {}
    for one in summary["refinements"]:
        found |= dict.fromkeys(one["registered"], (REGISTERED, "registered by the refinement"))
        found |= dict.fromkeys(one["weak"], (FEW, "keeps its initial pose"))
    for one in summary["models"]:
        if one["uncertainty"] is not None:
            found |= dict.fromkeys(one["uncertainty"]["undetermined"], (UNDETERMINED, ""))
            found |= dict.fromkeys(one["uncertainty"]["contradicted"], (CONTRADICTED, ""))
    found |= {one["name"]: (NO_POSE, one["reason"]) for one in summary["unregistered"]}
    return found | {one["name"]: (UNUSABLE, one["reason"]) for one in summary["rejected"]}


def _database_of_run(root: Path) -> tuple[Path | None, str]:
    """Where the verified matches are, and what to know about them."""
    if (root / FEATURES).is_file():
        return root / FEATURES, ""
    if (root / "database.db").is_file():
        note = "these are the matches of database.db, which agree with the model; the others are known with work/ only"
        return root / "database.db", note
    return None, "the run has no database of matches"


def _with_paths(facts: ModelFacts, root: Path) -> ModelFacts:
    """With the trajectories before loop closing and before bundle adjustment, and the segments as colours."""
    final = read_centres(root / "trajectory_tum.txt") if (root / "trajectory_tum.txt").is_file() else {}
    if len(final) != len(facts.names):
        return facts
    earlier = {
        "before loop closing": root / "trajectory_without_loops_tum.txt",
        "before bundle adjustment": root / "trajectory_stitched_tum.txt",
    }
    paths = [
        earlier_path(title, read_centres(path), final, facts.axes) for title, path in earlier.items() if path.is_file()
    ]
    colour_of: tuple[int, ...] = ()
    if (root / "work" / SEGMENTS_FILE).is_file():
        segments = list(enumerate(read_json(root / "work" / SEGMENTS_FILE)))
        number_of = {image: number for number, images in reversed(segments) for image in images}
        colour_of = tuple(number_of.get(image_id - 1, 0) for image_id in facts.observed.image_ids)
    return replace(facts, paths=(*paths, *facts.paths), colour_of=colour_of)


def _products(root: Path) -> tuple[str, ...]:
    models = sorted(path.relative_to(root).as_posix() for path in root.glob("sparse/*") if path.is_dir())
    return (*models, *(name for name in RunDirectory.RESULTS if (root / name).exists() and name != "report.html"))


def _is_calibrated(settings: str) -> bool:
    """The intrinsics were given: by camera_params of reconstruct, or by calibrated of refine."""
    return any(line.startswith(("camera_params =", "calibrated = true")) for line in settings.splitlines())


def _text_of(path: Path) -> str:
    with storage_errors(path):
        return path.read_text(encoding="utf-8") if path.is_file() else ""


def facts_of_failure(collection: ImageCollection, features: Path, reason: str) -> ReportFacts:
    """Of a run from which no model came out: what its images have in common.

    Args:
        features: database of the run; it may be missing.
        reason: the error.
    """
    counts = count_matches(features) if features.is_file() else {}
    states = {image.name: (NO_POSE, _matches_of(counts.get(k + 1))) for k, image in enumerate(collection.images)}
    states |= {one.name: (UNUSABLE, one.reason) for one in collection.rejected}
    thumbnails, note = _thumbnails(states, {image.name: image.path for image in collection.images})
    advice = "look for images without matches below; take more texture and overlap, and a step to the side"
    return ReportFacts(
        what=f"{len(collection)} images",
        verdict=Verdict(level="failed", reasons=(Reason(text=reason.rstrip("."), advice=advice, weight=1.0),)),
        num_more_reasons=0,
        summary={},
        images=tuple(
            ImageFacts(
                name=name,
                state=state,
                note=said,
                model="",
                row=None,
                num_observations=np.nan,
                error_px=np.nan,
                sigma_percent=np.nan,
                thumbnail=thumbnails.get(name, b""),
            )
            for name, (state, said) in sorted(states.items(), key=lambda one: natural_key(one[0]))
        ),
        thumbnails_note=note,
        model=None,
        products=(),
        settings="",
        versions=_versions(),
    )


def _matches_of(counts: tuple[int, int, int] | None) -> str:
    if counts is None:
        return "no features"
    num_features, num_matches, num_images = counts
    return f"{num_features} features, {num_matches} verified matches with {num_images} images"


# ------------------------------------------------------------------------------ models
def facts_of_model(folder: Path, images: Path | None, database: Path | None) -> ReportFacts:
    """Of a model that any program wrote.

    Args:
        folder: of its files. images: the folder of its images, or None.
        database: that it was made from, or None.

    Raises:
        InputError: a file of the model is broken; it names file and number. The database is none.
    """
    checked = read_colmap_model(folder)
    model = _read_model(checked.folder)
    name = "/".join(checked.folder.absolute().parts[-2:])
    note = "" if database is not None else "what matches say is not known without the database (--database)"
    facts = _model_facts(name, model, database=database, note=note, calibrated=False, stored=None, has_uncertainty=True)
    about = None if facts.uncertainty is None else summarise_uncertainty(facts.uncertainty)
    found = sorted(_reasons_about_model(name, facts, about), key=lambda reason: -reason.weight)
    states: dict[str, tuple[int, str]] = {}
    if about is not None:
        counts = zip(facts.names, facts.observed.num_observations, strict=True)
        states |= {name: (FEW, "") for name, count in counts if count < FEW_OBSERVATIONS}
        states |= dict.fromkeys(about.undetermined, (UNDETERMINED, ""))
        states |= dict.fromkeys(about.contradicted, (CONTRADICTED, ""))
    states |= {one.name: (NO_POSE, one.reason) for one in checked.unposed}
    failed = about is not None and about.predicted_error_percent >= FAILED_PERCENT
    level: Level = "failed" if failed else "weak" if found else "good"
    return ReportFacts(
        what=f"{len(facts.names)} images",
        verdict=Verdict(level=level, reasons=tuple(found[:MAX_REASONS])),
        num_more_reasons=max(len(found) - MAX_REASONS, 0),
        summary={"notes": checked.fixes},
        model=facts,
        products=(),
        settings="",
        versions=_versions(),
        **_images(states, {name: model}, facts, images),
    )


def _reasons_about_model(name: str, facts: ModelFacts, about: UncertaintySummary | None) -> Iterator[Reason]:
    """As those of a run, and the groups that contradict each other where none of them has most images."""
    if about is None:
        yield Reason(
            text=f"{name}: has no tracks, so its residuals and uncertainties are not known",
            advice="give its points, or refine it",
            weight=1.0,
        )
    else:
        yield from reasons_about(name, about, 1.0)
    if facts.agreement is not None and facts.agreement.is_split:
        sizes = [len(group.rows) for group in facts.agreement.groups]
        yield Reason(
            text=f"{name}: groups of {', '.join(map(str, sizes[:3]))} images contradict each other",
            advice="see the verification matrix; the model is folded or torn between them",
            weight=1 - sizes[0] / len(facts.names),
        )


# ------------------------------------------------------------------------------ shared
def _read_model(folder: Path) -> pycolmap.Reconstruction:
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(f"{folder}: no COLMAP model can be read here ({error})") from error


def _model_facts(
    folder: str,
    model: pycolmap.Reconstruction,
    *,
    database: Path | None,
    note: str,
    calibrated: bool,
    stored: Path | None,
    has_uncertainty: bool,
) -> ModelFacts:
    observed = observe(model)
    names = tuple(model.image(i).name for i in observed.image_ids)
    agreement = None
    if database is not None:
        features = read_verified(database, model)
        if features.verified:
            agreement = agreement_of(model, features)
        else:
            note = f"{database.name} has no verified matches of the images of this model"
    axes = plan_axes(observed.centres, observed.down)
    is_measured = has_uncertainty and len(observed.image_of) > 0
    return ModelFacts(
        folder=folder,
        names=names,
        observed=observed,
        cameras=camera_facts(model, observed, calibrated=calibrated, at_most=MAX_CAMERAS),
        num_cameras=len({model.image(i).camera_id for i in observed.image_ids}),
        uncertainty=_uncertainty(model, agreement, stored, calibrated=calibrated) if is_measured else None,
        agreement=agreement,
        agreement_note=note,
        paths=(Path2D(title=RESULT, rows=tuple(range(len(names))), xy=observed.centres @ axes.T),),
        axes=axes,
        colour_of=(),
    )


def _uncertainty(
    model: pycolmap.Reconstruction, agreement: Agreement | None, stored: Path | None, *, calibrated: bool
) -> ModelUncertainty:
    """That of the run, else measured."""
    if stored is not None and (stored / "uncertainties.json").is_file():
        return UNCERTAINTIES.read(stored)[0]
    ids = sorted(model.reg_image_ids())
    support = {} if agreement is None else agreement.support
    by_index = {(ids[i] - 1, ids[j] - 1): one for (i, j), one in support.items()}
    return measure_uncertainty(model, (by_index,), calibrated=calibrated)


def _images(
    states: Mapping[str, tuple[int, str]],
    models: Mapping[str, pycolmap.Reconstruction],
    shown: ModelFacts,
    folder: Path | None,
) -> dict[str, Any]:
    """The images of the report and the note on their thumbnails, as ``ReportFacts`` takes them."""
    owner = {model.image(i).name: name for name, model in models.items() for i in sorted(model.reg_image_ids())}
    names = sorted({*owner, *states}, key=natural_key)
    state_of = {name: states.get(name, (REGISTERED, "")) for name in names}
    row_of = {name: row for row, name in enumerate(shown.names)}
    counts, errors = shown.observed.num_observations, shown.observed.mean_errors_px
    sigmas: Mapping[str, float] = {}
    if shown.uncertainty is not None:
        percent = 100 * shown.uncertainty.position_sigma / shown.uncertainty.extent
        sigmas = dict(zip(shown.uncertainty.names, percent.tolist(), strict=True))
    files, note = _thumbnails_in(folder, state_of)
    found = tuple(
        ImageFacts(
            name=name,
            state=state_of[name][0],
            note=state_of[name][1],
            model=owner.get(name, ""),
            row=row_of.get(name),
            num_observations=float(counts[row_of[name]]) if name in row_of else np.nan,
            error_px=float(errors[row_of[name]]) if name in row_of else np.nan,
            sigma_percent=sigmas.get(name, np.nan),
            thumbnail=files.get(name, b""),
        )
        for name in names
    )
    return {"images": found, "thumbnails_note": note}


def _thumbnails_in(folder: Path | None, state_of: Mapping[str, tuple[int, str]]) -> tuple[dict[str, bytes], str]:
    if folder is None:
        return {}, "no thumbnails: it is not known where the images are (--images)"
    if not folder.is_dir():
        return {}, f"no thumbnails: the images are not in {folder.name} any more (--images)"
    return _thumbnails(state_of, {name: folder / name for name in state_of})


def _thumbnails(state_of: Mapping[str, tuple[int, str]], path_of: Mapping[str, Path]) -> tuple[dict[str, bytes], str]:
    """JPEG data by name, of at most ``MAX_THUMBNAILS`` images, those with a problem first; and why some have none."""
    usable = [name for name, (state, _) in state_of.items() if state != UNUSABLE]
    chosen = [name for name in usable if state_of[name][0] != REGISTERED][:MAX_THUMBNAILS]
    plain = [name for name in usable if state_of[name][0] == REGISTERED]
    room = MAX_THUMBNAILS - len(chosen)
    if plain and room:
        chosen += plain[:: max(1, -(-len(plain) // room))]
    paths = {name: path_of[name] for name in chosen}
    made, problem = make_thumbnails(list(paths.values()), workers=usable_cores())
    notes = []
    if len(chosen) < len(usable):
        notes.append(f"{len(chosen)} of {len(usable)} images have a thumbnail, those with a problem first")
    if problem:
        notes.append(f"images without a thumbnail: {problem}")
    return {name: made[path] for name, path in paths.items() if path in made}, "; ".join(notes)


def _versions() -> dict[str, str]:
    """Of the program, of Python and of the packages that matter."""
    found = {"smust3r-colmap": __version__, "Python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
