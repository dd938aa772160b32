"""The command line: parse, call one public function, print.

Every command is a thin function that imports what it needs inside its body, so that `--help`
stays fast and one broken dependency does not take the other commands down.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from colmap_netvlad import __version__
from colmap_netvlad.runtime.errors import EXIT_PARTIAL
from colmap_netvlad.training.command import SettingsCommand

if TYPE_CHECKING:
    from colmap_netvlad.commands.georegister import ControlFile
    from colmap_netvlad.matching.run import MatchReport
    from colmap_netvlad.project import Project

Command = TypeVar("Command", bound=Callable[..., Any])

FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)

# Options that several commands share, each worded once.

database_option = click.option(
    "--db",
    "--database_path",
    "database",
    type=click.Path(path_type=Path),
    help="COLMAP database.  [default: project.db or database.db in the current folder]",
)
images_option = click.option(
    "--images",
    "--image_path",
    "images",
    type=click.Path(path_type=Path),
    help="Folder that image names are relative to."
    "  [default: the folder used last, else images/ beside the database]",
)
k_option = click.option(
    "--k", default=30, show_default=True, help="Partners retrieved for each image."
)
model_option = click.option(
    "--model",
    type=FILE,
    help="Checkpoint (.safetensors) of the descriptor model, instead of a named --method.",
)
device_option = click.option(
    "--device", help="Where networks run: cpu, cuda, cuda:1, mps.  [default: the fastest there is]"
)
cache_option = click.option(
    "--cache",
    type=click.Path(path_type=Path),
    help="Our own file of descriptors and rankings.  [default: project.netvlad.db beside the"
    " database]",
)
seed_option = click.option(
    "--seed", default=0, show_default=True, help="Seed of every random choice."
)
method_option = click.option(
    "--method",
    default="hybrid",
    show_default=True,
    help="Retrieval method of --rounds; `colmap-netvlad methods` lists them.",
)
pairs_option = click.option(
    "--pairs",
    type=click.Path(path_type=Path),
    help="Pairs list (COLMAP's, .csv or .json).  [default: pairs.txt beside the database]",
)
gps_option = click.option(
    "--gps",
    type=click.Choice(["auto", "off", "require"]),
    help="Whether positions (priors or EXIF) re-weight the candidates.  [default: auto for hybrid,"
    " off for the methods of the literature]",
)
rerank_option = click.option(
    "--rerank",
    type=click.IntRange(min=0),
    default=100,
    show_default=True,
    help="Candidates of each image that deep methods compare place by place; 0: none, the global"
    " descriptors alone as in the paper.",
)
sparse_option = click.option(
    "--sparse",
    type=click.Path(path_type=Path),
    required=True,
    help="A COLMAP model, or a folder of models 0, 1, ...",
)
copy_option = click.option(
    "--copy",
    is_flag=True,
    help="Leave the database as it is and write matches into <name>.copy.db beside it.",
)


def rounds_options(command: Command) -> Command:
    """Add the options of matching in rounds."""
    for option in (
        click.option(
            "--budget",
            type=int,
            help="Most pairs that --rounds matches.  [default: k times the number of images]",
        ),
        click.option(
            "--rounds",
            type=int,
            help="Match in this many rounds, each choosing its pairs by what the earlier ones"
            " taught, instead of a pairs list.",
        ),
    ):
        command = option(command)
    return command


def gcp_options(command: Command) -> Command:
    """Add the options of ground control."""
    for option in (
        click.option(
            "--check",
            multiple=True,
            help="Name of a ground point that only checks the model; may be given several times.",
        ),
        click.option(
            "--gcp",
            type=FILE,
            help="Ground points in OpenDroneMap's format (system, then x y z px py photo name):"
            " they place the model and are held in a last adjustment.",
        ),
    ):
        command = option(command)
    return command


def control_file(gcp: Path | None, check: tuple[str, ...]) -> ControlFile | None:
    """Return what --gcp and --check name."""
    from colmap_netvlad.commands.georegister import ControlFile

    if gcp is None and check:
        raise click.UsageError("--check names points of --gcp; give the list.")
    return None if gcp is None else ControlFile(gcp, check)


def verbose_option(command: Command) -> Command:
    """Add -v, which lets pycolmap's own log through."""

    def set_verbosity(context: click.Context, parameter: click.Parameter, verbose: bool) -> None:
        if not context.resilient_parsing:
            from colmap_netvlad.runtime import progress

            progress.verbose = verbose

    return click.option(
        "-v",
        "--verbose",
        is_flag=True,
        expose_value=False,
        callback=set_verbosity,
        help="Show COLMAP's own log on standard error.",
    )(command)


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, "--version", prog_name="colmap-netvlad")
def cli() -> None:
    """Deep image pair retrieval for COLMAP on drone flights.

    From a folder of photos to a sparse model:

    \b
      colmap-netvlad features --images photos --db project.db
      colmap-netvlad pairs --db project.db --k 30
      colmap-netvlad reconstruct --db project.db
    """


@cli.command()
@click.option(
    "--images",
    "--image_path",
    "images",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder of photos; subfolders are searched, names are relative to it.",
)
@click.option(
    "--db",
    "--database_path",
    "database",
    type=click.Path(path_type=Path),
    default=Path("project.db"),
    show_default=True,
    help="COLMAP database to write; made where it is not there.",
)
@click.option(
    "--camera",
    default="auto",
    show_default=True,
    help="Which photos share a camera: auto (equal make, model, focal length and size; without"
    " EXIF equal folder and size), single, per-folder, per-image.",
)
@click.option(
    "--camera-model",
    default="SIMPLE_RADIAL",
    show_default=True,
    help="COLMAP's model of new cameras, SIMPLE_RADIAL or OPENCV for example.",
)
@click.option(
    "--max-image-size",
    type=int,
    help="Longer side at which SIFT runs, px.  [default: COLMAP's, 3200]",
)
@click.option("--max-features", default=8192, show_default=True, help="Most features of a photo.")
@click.option(
    "--masks",
    type=click.Path(path_type=Path),
    help="Folder of masks in COLMAP's way (<photo>.png, black is ignored).",
)
@click.option(
    "--threads", type=int, help="Photos at once.  [default: as processors and memory allow]"
)
@verbose_option
def features(images: Path, database: Path, **options: Any) -> None:
    """Import photos into a COLMAP database and extract SIFT features.

    This writes the database; one of COLMAP 3.x is brought to the schema of COLMAP 4. Photos that
    have features are passed over, so a stopped run goes on where it stopped. Photos that are
    truncated, empty or no photos are listed at the end and left out (exit code 3).
    """
    from colmap_netvlad.cache.store import Store
    from colmap_netvlad.colmap.features import FeatureOptions, extract_features
    from colmap_netvlad.project import Project

    report = extract_features(images, database, FeatureOptions(**options))
    with Store(Project(database, images).cache) as store:
        store.remember_images(images)
    click.echo(
        f"Photos: {report.photos:,}, {report.already:,} with features before, "
        f"{report.extracted:,} extracted now ({report.features:,} features), "
        f"{report.cameras:,} camera{'s' if report.cameras != 1 else ''} in {database}."
    )
    click.echo(f"Next: colmap-netvlad pairs --db {quoted(database)}")
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.bad])


@cli.command()
@database_option
@images_option
@pairs_option
@click.option(
    "--output",
    "--output_path",
    "output",
    type=click.Path(path_type=Path),
    help="Folder of the models.  [default: sparse beside the database; sparse-2, sparse-3, ..."
    " where there are models already]",
)
@click.option(
    "--mapper",
    default="auto",
    show_default=True,
    help="How the model is built: incremental (COLMAP's), parallel (in clusters, for large"
    " flights), hierarchical or global (COLMAP's); auto: incremental for small flights, parallel"
    " for large ones.",
)
@click.option(
    "--cluster-size",
    type=click.IntRange(min=3),
    help="Images of a cluster of parallel and hierarchical mapping.  [default: 250]",
)
@click.option(
    "--threads", type=click.IntRange(min=1), help="Processors for mapping.  [default: all]"
)
@click.option(
    "--memory",
    type=click.FloatRange(min=0, min_open=True),
    help="GiB that the workers of parallel mapping may take.  [default: 70 % of the machine's]",
)
@click.option(
    "--georegister",
    type=click.Choice(["auto", "off", "require"]),
    default="auto",
    show_default=True,
    help="Whether the model is brought into the world, in m, by position priors or EXIF GPS.",
)
@click.option(
    "--use-gps",
    is_flag=True,
    help="Adjust with the positions as priors, robustly: against drift and dome-shaped errors, and"
    " for the focal length. Mappers incremental and parallel.",
)
@click.option(
    "--gps-std",
    type=(click.FloatRange(min=0, min_open=True),) * 2,
    help="Standard deviations of the positions for --use-gps, m horizontal and vertical."
    "  [default: what the database's priors, XMP (RTK) or EXIF state of each photo, else 3 and 5]",
)
@gcp_options
@copy_option
@rounds_options
@k_option
@method_option
@device_option
@seed_option
@verbose_option
def reconstruct(
    database: Path | None,
    images: Path | None,
    pairs: Path | None,
    output: Path | None,
    mapper: str,
    cluster_size: int | None,
    threads: int | None,
    memory: float | None,
    georegister: Any,
    use_gps: bool,
    gps_std: tuple[float, float] | None,
    gcp: Path | None,
    check: tuple[str, ...],
    copy: bool,
    rounds: int | None,
    budget: int | None,
    k: int,
    method: str,
    device: str | None,
    seed: int,
) -> None:
    """Match the pairs, verify them, and build the sparse model.

    This writes matches into the database, where COLMAP keeps them (--copy does not); one of
    COLMAP 3.x is brought to the schema of COLMAP 4. Pairs matched before are not matched again,
    so a stopped run goes on where it stopped.
    """
    from rich.console import Console

    from colmap_netvlad.commands.reconstruct import (
        ReconstructOptions,
        check_mapper,
        map_and_report,
        report_lines,
        report_table,
        working_copy,
    )
    from colmap_netvlad.commands.reconstruct import reconstruct as run
    from colmap_netvlad.mapping.options import MappingOptions
    from colmap_netvlad.matching.run import MatchOptions
    from colmap_netvlad.project import find_project

    check_mapper(mapper, use_gps=use_gps)
    if gps_std is not None and not use_gps:
        raise click.UsageError("--gps-std says how good the positions of --use-gps are; add it.")
    project = find_project(database, images)
    pairs = pairs or project.pairs
    output = output or project.sparse
    if copy:
        project = working_copy(project)
    mapping = MappingOptions(
        seed=seed,
        threads=threads,
        cluster_size=cluster_size,
        memory=None if memory is None else memory * 2**30,
    )
    options = ReconstructOptions(
        mapper,
        mapping,
        MatchOptions(seed=seed),
        georegister,
        use_gps,
        gps_std,
        control_file(gcp, check),
    )
    if rounds is None:
        report = run(project, pairs, output, options)
    else:
        matches = match_and_print_rounds(project, rounds, budget, k, method, device, seed)
        report = map_and_report(project, matches, output, options)
    Console().print(report_table(report))
    click.echo("\n".join(report_lines(report)))
    click.echo(f"Matches are in {project.database}, models in {report.output}.")


@cli.command()
@database_option
@images_option
@pairs_option
@copy_option
@rounds_options
@k_option
@method_option
@device_option
@seed_option
@verbose_option
def match(
    database: Path | None,
    images: Path | None,
    pairs: Path | None,
    copy: bool,
    rounds: int | None,
    budget: int | None,
    k: int,
    method: str,
    device: str | None,
    seed: int,
) -> None:
    """Match and verify the pairs of a list, or spend a budget of pairs in --rounds.

    This writes matches into the database, where COLMAP keeps them (--copy does not); one of
    COLMAP 3.x is brought to the schema of COLMAP 4. A stopped run goes on where it stopped.
    """
    from colmap_netvlad.colmap.database import image_names
    from colmap_netvlad.commands.reconstruct import view_graph_lines, working_copy
    from colmap_netvlad.graph.verified import verified_components
    from colmap_netvlad.matching.run import MatchOptions, match_pairs
    from colmap_netvlad.pairs.lists import read_pairs
    from colmap_netvlad.project import find_project

    project = find_project(database, images)
    listed = pairs or project.pairs
    if copy:
        project = working_copy(project)
    if rounds is None:
        chosen = read_pairs(listed, image_names(project.database))
        report = match_pairs(project.database, chosen, MatchOptions(seed=seed))
    else:
        report = match_and_print_rounds(project, rounds, budget, k, method, device, seed)
    click.echo(
        f"Pairs: {report.requested:,} ({report.already:,} matched before), {report.verified:,} "
        f"verified, {report.seconds / 60:.1f} minutes. Matches are in {project.database}."
    )
    for line in view_graph_lines(verified_components(project.database)):
        click.echo(line)


def match_and_print_rounds(
    project: Project,
    rounds: int,
    budget: int | None,
    k: int,
    method: str,
    device: str | None,
    seed: int,
) -> MatchReport:
    """Match in rounds and print a line for each."""
    from colmap_netvlad.matching.rounds import rank_and_match_in_rounds, rounds_lines
    from colmap_netvlad.matching.run import MatchOptions
    from colmap_netvlad.retrieval.options import RetrievalOptions

    options = RetrievalOptions(k=k, device=device, seed=seed)
    spent = rank_and_match_in_rounds(
        project, method, options, rounds, budget, MatchOptions(seed=seed)
    )
    for line in rounds_lines(spent):
        click.echo(line)
    return spent.matches


@cli.command()
@database_option
@click.option(
    "--images",
    "--image_path",
    "images",
    type=click.Path(path_type=Path),
    help="The photo folder, with the new photos copied beside the old ones."
    "  [default: the folder used last, else images/ beside the database]",
)
@click.option(
    "--sparse",
    type=click.Path(path_type=Path),
    help="Folder of the model to extend.  [default: sparse/0, or 0 of the newest sparse-N]",
)
@click.option(
    "--output",
    "--output_path",
    "output",
    type=click.Path(path_type=Path),
    help="Folder of the extended model.  [default: the next sparse-N beside the database]",
)
@click.option("--among-new", is_flag=True, help="Pair the new photos with each other as well.")
@k_option
@method_option
@device_option
@seed_option
@verbose_option
def add(
    database: Path | None,
    images: Path | None,
    sparse: Path | None,
    output: Path | None,
    among_new: bool,
    k: int,
    method: str,
    device: str | None,
    seed: int,
) -> None:
    """Register new photos into an existing model.

    This writes the database: features and matches of the new photos. Only what is new is
    computed: a new photo is paired with its k most likely partners among the old ones. The old
    model is left as it is, the extended one is written beside it.
    """
    from colmap_netvlad.commands.add import AddOptions, add_lines, add_photos, newest_model
    from colmap_netvlad.project import find_project
    from colmap_netvlad.retrieval.options import RetrievalOptions

    project = find_project(database, images)
    options = AddOptions(
        method, RetrievalOptions(k=k, device=device, seed=seed), among_new=among_new, seed=seed
    )
    report = add_photos(project, sparse or newest_model(project), options, output)
    for line in add_lines(report):
        click.echo(line)
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.features.bad])


@cli.command()
@sparse_option
@click.option(
    "--db",
    "--database_path",
    "database",
    type=FILE,
    help="COLMAP database, for its position priors.  [default: project.db or database.db beside"
    " the model's folder, where there is one]",
)
@click.option(
    "--images",
    "--image_path",
    "images",
    type=FOLDER,
    help="Photo folder, for EXIF GPS.  [default: images/ beside the model's folder, where there"
    " is one]",
)
@click.option(
    "--output",
    "--output_path",
    "output",
    type=click.Path(path_type=Path),
    help="Folder of the models in the world.  [default: the given one's name + -georegistered]",
)
@gcp_options
@seed_option
@verbose_option
def georegister(
    sparse: Path,
    database: Path | None,
    images: Path | None,
    output: Path | None,
    gcp: Path | None,
    check: tuple[str, ...],
    seed: int,
) -> None:
    """Bring any COLMAP model into the world: m east, north, up of a stated origin.

    The model is aligned robustly to position priors of a database or to EXIF GPS and written to
    a new folder, with georeference.json (origin, EPSG code of the UTM zone, transform, residuals)
    in it. A database is not needed: the photos' GPS is enough.
    """
    from colmap_netvlad.commands.georegister import beside
    from colmap_netvlad.commands.georegister import georegister as run

    database, images = beside(sparse, database, images)
    report = run(sparse, output, database, images, control_file(gcp, check), seed)
    for placed in report.models:
        for line in placed.lines():
            click.echo(f"{placed.name}: {line}")
    for line in report.notes:
        click.echo(line)
    click.echo(f"Written to {report.output}.")
    finish_partial(
        [f"Left out: {one.name}: {one.fault}" for one in report.models if one.georeference is None]
    )


@cli.command()
@sparse_option
@click.option(
    "--db",
    "--database_path",
    "database",
    type=FILE,
    help="COLMAP database, for the verified pairs.  [default: project.db or database.db beside the"
    " model's folder; without one, pairs are those with common 3D points]",
)
@click.option(
    "--format",
    "formats",
    multiple=True,
    type=click.Choice(["cameras", "footprints", "pairs", "shots", "csv", "las", "ply", "text"]),
    help="What to write; may be given several times.  [default: all]",
)
@click.option(
    "--crs",
    help="Projected system of CSV, LAS and shots: EPSG:25832 for example."
    "  [default: the UTM zone of the model]",
)
@click.option(
    "--output",
    "--output_path",
    "output",
    type=click.Path(path_type=Path),
    help="A new folder.  [default: the model's name + -export]",
)
def export(
    sparse: Path,
    database: Path | None,
    formats: tuple[str, ...],
    crs: str | None,
    output: Path | None,
) -> None:
    """Write a georegistered model for other programs.

    Cameras, footprints and pairs with weak links as GeoJSON, OpenDroneMap's shots.geojson,
    cameras as CSV (easting, northing, height, omega, phi, kappa), points as LAS and PLY, and
    COLMAP's text files.
    """
    from colmap_netvlad.commands.export import export as run
    from colmap_netvlad.commands.georegister import beside

    report = run(sparse, formats, output, beside(sparse, database, None)[0], crs)
    for file in report.files:
        click.echo(file)
    system = "" if report.crs is None else f"; CSV, LAS and shots in {report.crs}"
    click.echo(f"{len(report.files)} files in {report.output}{system}.")


@cli.command()
@database_option
@images_option
@click.option(
    "--sparse",
    "sparse",
    type=click.Path(path_type=Path),
    multiple=True,
    required=True,
    help="A COLMAP model, or a folder of models 0, 1, ...; given twice or more.",
)
@click.option(
    "--output",
    "--output_path",
    "output",
    type=click.Path(path_type=Path),
    help="Folder of the models.  [default: the next sparse-N beside the database]",
)
@click.option(
    "--across",
    type=click.IntRange(min=1),
    default=10,
    show_default=True,
    help="Partners in other models that each image is matched with.",
)
@method_option
@device_option
@seed_option
@verbose_option
def merge(
    database: Path | None,
    images: Path | None,
    sparse: tuple[Path, ...],
    output: Path | None,
    across: int,
    method: str,
    device: str | None,
    seed: int,
) -> None:
    """Put models of one project together: several flights, days or heights.

    Pairs across the models are retrieved, matched and verified (this writes the database); one
    similarity is solved for all models at once, then all is adjusted together. Models that cannot
    be joined stay and are named.
    """
    from colmap_netvlad.commands.merge import MergeOptions, merge_lines, merge_models
    from colmap_netvlad.project import find_project
    from colmap_netvlad.retrieval.options import RetrievalOptions

    options = MergeOptions(method, RetrievalOptions(device=device, seed=seed), across, seed)
    for line in merge_lines(merge_models(find_project(database, images), sparse, output, options)):
        click.echo(line)


def quoted(path: Path) -> str:
    """Return a path as the user's shell takes it."""
    return shlex.quote(str(path))


@cli.command()
@database_option
@images_option
@k_option
@click.option(
    "--method", default=None, help="Retrieval method; `colmap-netvlad methods` lists them."
)
@model_option
@click.option(
    "--format",
    type=click.Choice(["colmap", "csv", "json"]),
    default="colmap",
    show_default=True,
    help="COLMAP's pairs list, or with scores and ranks.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    help="The pairs list.  [default: pairs.txt beside the database]",
)
@click.option(
    "--exact/--hnsw",
    default=None,
    help="Force exact or approximate (HNSW) search.  [default: by the number of images]",
)
@click.option("--vocab-tree", type=FILE, help="Vocabulary tree of the method bow.")
@gps_option
@rerank_option
@click.option(
    "--other-cameras",
    type=float,
    default=0.0,
    show_default=True,
    help="Least share of an image's partners that other cameras took, for mixed flights.",
)
@click.option(
    "--sequential",
    type=int,
    default=0,
    show_default=True,
    help="Pair each photo with this many that follow it by name too (video, flight lines).",
)
@click.option(
    "--masks",
    type=FOLDER,
    help="Folder of masks in COLMAP's way (<photo>.png): black areas are neutral to networks.",
)
@click.option("--join", "own_pairs", type=FILE, help="A pairs list of your own to join in.")
@click.option(
    "--connect/--no-connect",
    default=True,
    show_default=True,
    help="Where each image's k nearest leave the images in several components, add the best few"
    " pairs between these (5 % at most).",
)
@cache_option
@device_option
@seed_option
@verbose_option
def pairs(
    database: Path | None,
    images: Path | None,
    k: int,
    method: str | None,
    model: Path | None,
    format: str,
    output: Path | None,
    exact: bool | None,
    vocab_tree: Path | None,
    gps: str | None,
    rerank: int,
    other_cameras: float,
    sequential: int,
    own_pairs: Path | None,
    masks: Path | None,
    connect: bool,
    cache: Path | None,
    device: str | None,
    seed: int,
) -> None:
    """Retrieve the k nearest partners of each image and write the pairs list.

    Never writes to the database. Descriptors are kept in project.netvlad.db beside it: a second
    run computes none, ten new photos cost ten.
    """
    from colmap_netvlad.commands.pairs import make_pairs, summary
    from colmap_netvlad.models.catalogue import DEFAULT
    from colmap_netvlad.pairs.rules import PartnerRules
    from colmap_netvlad.project import find_project
    from colmap_netvlad.retrieval.options import RetrievalOptions

    project = find_project(database, images, cache)
    options = RetrievalOptions(
        k=k,
        model=model,
        device=device,
        seed=seed,
        vocab_tree=vocab_tree,
        exact=exact,
        masks=masks,
        gps=gps,
        rerank=rerank,
    )
    rules = PartnerRules(other_cameras, sequential, own_pairs)
    report = make_pairs(project, method or DEFAULT, options, format, output, rules, connect)
    for line in summary(project, report):
        click.echo(line)
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.ranking.left_out])


@cli.command()
@database_option
@click.option(
    "--graphml", type=FILE, help="Also write the graph for Gephi, yEd or Cytoscape (GraphML)."
)
def viewgraph(database: Path | None, graphml: Path | None) -> None:
    """Show how well the verified pairs hold the flight together.

    Components, images per pair, and the images and pairs whose loss splits the model. The
    database stays as it is.
    """
    from colmap_netvlad.graph.viewgraph import read_view_graph, statistics_lines
    from colmap_netvlad.project import locate_database

    graph = read_view_graph(locate_database(database))
    if graphml is not None:
        graph.write_graphml(graphml)
    click.echo("\n".join(statistics_lines(graph.statistics())))


@cli.command()
def methods() -> None:
    """List the retrieval methods and their sources."""
    from colmap_netvlad.retrieval.methods import METHODS

    width = max(map(len, METHODS))
    for method in METHODS.values():
        click.echo(f"{method.name:{width}}  {method.summary}")


@cli.command()
@click.option(
    "--output",
    type=FOLDER,
    default=Path("colmap-netvlad-demo"),
    show_default=True,
    help="Folder of the demo: new, or that of a demo to go on with.",
)
@click.option("--method", help="Retrieval method.  [default: as `pairs`]")
@seed_option
@verbose_option
def demo(output: Path, method: str | None, seed: int) -> None:
    """Render a small drone flight, reconstruct it, and check the result against the truth.

    Takes about two minutes. Exit code 1 where a photo is not registered, or a camera centre is
    off by more than 1 % of the flight's extent.
    """
    from dataclasses import replace

    from rich.console import Console

    from colmap_netvlad.commands.demo import DEMO_FLIGHT, run_demo
    from colmap_netvlad.models.catalogue import DEFAULT

    console = Console(highlight=False, soft_wrap=True)
    flight = replace(DEMO_FLIGHT, seed=seed)
    if not run_demo(output, method or DEFAULT, flight, console.print).passed:
        sys.exit(1)


@cli.command()
@database_option
@images_option
@click.option(
    "--methods",
    default="bow,vlad",
    show_default=True,
    help="Methods, and checkpoints by path, with commas; `colmap-netvlad methods` lists them.",
)
@click.option(
    "--k",
    "ks",
    default="30",
    show_default=True,
    help="Partners retrieved for each image, one number or several: 10,20,30.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    help="Folder of the comparison.  [default: <database>-compare beside the database]",
)
@click.option(
    "--reconstruct/--no-reconstruct",
    "build",
    default=True,
    help="Make each method's model, or stop after matching.  [default: make it]",
)
@click.option(
    "--reconstruct-k", type=int, help="Which of --k the models are made from.  [default: largest]"
)
@click.option("--vocab-tree", type=FILE, help="Vocabulary tree of the method bow.")
@rerank_option
@click.option("--yes", is_flag=True, help="Do not ask before a long exhaustive matching.")
@cache_option
@device_option
@seed_option
@verbose_option
def compare(
    database: Path | None,
    images: Path | None,
    methods: str,
    ks: str,
    output: Path | None,
    build: bool,
    reconstruct_k: int | None,
    vocab_tree: Path | None,
    rerank: int,
    yes: bool,
    cache: Path | None,
    device: str | None,
    seed: int,
) -> None:
    """Compare retrieval methods on your own flight, and write a report page.

    Each method starts from the features of the database, which is only read; all work is done on
    copies in the comparison's folder. Pairs that several methods ask for are matched once. A
    killed run goes on where it stopped, and methods can be added in a later run. A method that
    fails is listed at the end, the others finish (exit code 3).
    """
    from colmap_netvlad.commands.compare import CompareOptions, parse_ks
    from colmap_netvlad.commands.compare import compare as run
    from colmap_netvlad.project import find_project
    from colmap_netvlad.report.comparison import print_comparison
    from colmap_netvlad.retrieval.options import RetrievalOptions

    def confirm(question: str) -> bool:
        return yes or (sys.stdin.isatty() and click.confirm(question, err=True))

    options = CompareOptions(
        ks=parse_ks(ks),
        output=output,
        reconstruct=build,
        reconstruct_k=reconstruct_k,
        retrieval=RetrievalOptions(device=device, vocab_tree=vocab_tree, rerank=rerank),
        seed=seed,
    )
    names = [name.strip() for name in methods.split(",") if name.strip()]
    comparison, workspace = run(find_project(database, images, cache), names, options, confirm)
    print_comparison(comparison)
    click.echo(f"Report: {workspace.html} (figures: {workspace.json.name}, {workspace.csv.name})")
    finish_partial([f"Not finished: {sentence}" for sentence in comparison.incomplete])


@cli.command()
@click.argument("datasets", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--output",
    type=FOLDER,
    help="Where annotations and working files go, a folder for each scene.  [default: beside"
    " each scene's photos]",
)
@click.option(
    "--databases",
    type=FOLDER,
    help="Folder of matched COLMAP databases, <scene>.db: a scene found there is neither extracted"
    " nor matched again; the database is copied and stays as it is.",
)
@click.option(
    "--method", default="bow", show_default=True, help="Retrieval method that chooses the pairs."
)
@k_option
@click.option(
    "--mapper",
    default="incremental",
    show_default=True,
    help="Mapping method; none: tracks of verified matches stand for 3D points (fast, no poses).",
)
@seed_option
@verbose_option
def annotate(
    datasets: tuple[Path, ...],
    output: Path | None,
    databases: Path | None,
    method: str,
    k: int,
    mapper: str,
    seed: int,
) -> None:
    """Annotate scenes for training: which photos see the same 3D points.

    DATASETS are folders of scenes (<scene>/images, or photos right in <scene>), or single scenes.
    Each scene is reconstructed; the number of common 3D points of its photos (GS) is saved as
    annotation.npz. Scenes annotated before are passed over.
    """
    from colmap_netvlad.commands import annotate as annotation

    options = annotation.AnnotateOptions(method, k, output, databases, mapper, seed)
    report = annotation.annotate(datasets, options)
    for line in annotation.table_lines(report.scenes):
        click.echo(line)
    finish_partial(report.left_out)


@cli.command(cls=SettingsCommand)
@click.argument("datasets", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--output", type=FOLDER, required=True, help="Folder of the run; an unfinished one goes on."
)
@click.option(
    "--validation",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Annotated scenes never trained on, by which the best epoch is chosen.",
)
@click.option("--leave-out", multiple=True, help="Name of a scene in DATASETS not to train on.")
@click.option("--recipe", type=FILE, help="TOML file of settings; options given here come first.")
@click.option("--name", help="What the model calls itself.  [default: the run's folder]")
@device_option
@click.pass_context
def train(
    context: click.Context,
    datasets: tuple[Path, ...],
    output: Path,
    validation: tuple[Path, ...],
    leave_out: tuple[str, ...],
    recipe: Path | None,
    name: str | None,
    device: str | None,
    **settings: Any,
) -> None:
    """Train a descriptor model on annotated scenes (the paper's recipe by default).

    DATASETS are what `annotate` annotated. OUTPUT gets best.safetensors, to be used as
    `--model`, the training curves, and a checkpoint that a stopped run goes on from.
    """
    from colmap_netvlad.training.command import settings_of
    from colmap_netvlad.training.run import report_lines
    from colmap_netvlad.training.run import train as run
    from colmap_netvlad.training.scenes import load_dataset

    options = settings_of(context, recipe)
    measured = load_dataset(validation)
    scenes = load_dataset(datasets, (*leave_out, *(scene.name for scene in measured)))
    report = run(scenes, measured, options, output, device=device, name=name)
    for line in report_lines(report):
        click.echo(line)
    finish_partial(report.left_out)


def finish_partial(left_out: list[str]) -> None:
    """List on standard error what a finished command left out, and exit with EXIT_PARTIAL."""
    if not left_out:
        return
    for line in left_out:
        click.echo(line, err=True)
    sys.exit(EXIT_PARTIAL)


def main() -> None:
    """Run the command line: the entry point `colmap-netvlad`."""
    cli()


if __name__ == "__main__":
    main()
