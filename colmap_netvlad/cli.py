"""The command line: parse, call one public function, print.

Every command is a thin function that imports what it needs inside its body, so that `--help`
stays fast and one broken dependency does not take the other commands down. Options that several
commands share stand in `cli_options`.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from colmap_netvlad.cli_options import (
    FILE,
    FOLDER,
    PATH,
    cluster_option,
    contradicted_option,
    database_option,
    device_option,
    feature_options,
    given,
    ground_options,
    json_option,
    k_option,
    mapping_options,
    masks_option,
    matcher_options,
    matching_options,
    method_option,
    model_database_option,
    model_images_option,
    output_option,
    place_options,
    project_options,
    refuse,
    retrieval_options,
    seed_option,
    sparse_option,
    verbose_option,
    written_project_options,
)
from colmap_netvlad.cli_settings import SettingsCommand
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import EXIT_PARTIAL
from colmap_netvlad.runtime.files import remove_scratch
from colmap_netvlad.runtime.plain import plain
from colmap_netvlad.runtime.shell import command_line
from colmap_netvlad.runtime.version import VERSION
from colmap_netvlad.terminal import Group, hear_interrupts, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from colmap_netvlad.colmap.features import FeatureOptions
    from colmap_netvlad.commands.georegister import ControlFile, WorldOptions
    from colmap_netvlad.commands.match import RoundsOptions
    from colmap_netvlad.commands.report import FlightReport
    from colmap_netvlad.mapping.options import MappingOptions
    from colmap_netvlad.matching.options import MatchOptions
    from colmap_netvlad.project import Project


def numbers(context: click.Context, parameter: click.Parameter, text: str) -> tuple[int, ...]:
    """Read `10,20,30`."""
    try:
        return tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise click.ClickException(
            f"--k is {text!r}; it is a whole number or several with commas, as in --k 10,20,30."
        ) from None


@click.group(
    cls=Group,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(VERSION, "--version", prog_name="colmap-netvlad")
def cli() -> None:
    """Deep image pair retrieval for COLMAP on drone flights.

    From a folder of photos to a sparse model:

    \b
      colmap-netvlad features --images photos --db project.db
      colmap-netvlad pairs --db project.db --k 30
      colmap-netvlad reconstruct --db project.db
    """
    remove_scratch()


@cli.command()
@click.option(
    "--images",
    "--image_path",
    "images",
    type=PATH,
    required=True,
    help="Folder of photos; subfolders are searched, names are relative to it.",
)
@click.option(
    "--db",
    "--database_path",
    "database",
    type=PATH,
    default=Path("project.db"),
    show_default=True,
    help="COLMAP database to write; made where it is not there.",
)
@feature_options
@masks_option
@verbose_option
@cluster_option
def features(images: Path, database: Path, features: FeatureOptions, masks: Path | None) -> None:
    """Import photos into a COLMAP database and extract SIFT features.

    This writes the database; one of COLMAP 3.x is brought to the schema of COLMAP 4. Photos that
    have features are passed over, so a stopped run goes on where it stopped. Photos that are
    truncated, empty or no photos are listed at the end and left out (exit code 3).
    """
    from colmap_netvlad.commands.features import import_photos, report_lines

    report = import_photos(images, database, replace(features, masks=masks))
    say(*report_lines(report, images, database))
    words = ["colmap-netvlad", "pairs", "--db", str(database)]
    click.echo(f"Next: {command_line(words)}")
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.bad])


@cli.command()
@project_options
@k_option
@click.option(
    "--method", default=None, help="Retrieval method; `colmap-netvlad methods` lists them."
)
@click.option(
    "--descriptors",
    type=FILE,
    help="Rank by global descriptors of others (MegaLoc, SALAD, ...) in hloc's HDF5 layout.",
)
@retrieval_options
@click.option(
    "--format",
    type=click.Choice(["colmap", "csv", "json"]),
    help="COLMAP's pairs list, or with scores and ranks.  [default: as the name of --output ends,"
    " else colmap]",
)
@click.option(
    "--output", type=PATH, help="The pairs list.  [default: pairs.txt beside the database]"
)
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
    "--across",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Pair each photo with this many of other flights too: of another folder, day or camera.",
)
@click.option("--join", "own_pairs", type=FILE, help="A pairs list of your own to join in.")
@click.option(
    "--connect/--no-connect",
    default=True,
    show_default=True,
    help="Where each image's k nearest leave the images in several components, add the best few"
    " pairs between these (5 % at most).",
)
@click.option(
    "--export", type=PATH, help="Also write our global descriptors there, in hloc's HDF5 layout."
)
@json_option
@verbose_option
@cluster_option
def pairs(
    project: Project,
    k: int,
    method: str | None,
    descriptors: Path | None,
    retrieval: RetrievalOptions,
    format: str | None,
    output: Path | None,
    other_cameras: float,
    sequential: int,
    across: int,
    own_pairs: Path | None,
    connect: bool,
    export: Path | None,
    as_json: bool,
) -> None:
    """Retrieve the k nearest partners of each image and write the pairs list.

    Never writes to the database. Descriptors are kept in project.netvlad.db beside it: a second
    run computes none, ten new photos cost ten.
    """
    from colmap_netvlad.commands.pairs import as_json as as_dictionary
    from colmap_netvlad.commands.pairs import make_pairs, summary
    from colmap_netvlad.models.catalogue import DEFAULT
    from colmap_netvlad.pairs.rules import PartnerRules

    if descriptors is not None:
        refuse(given("method"), "would be ignored: --descriptors rank; leave one out.")
    report = make_pairs(
        project,
        str(descriptors or method or DEFAULT),
        replace(retrieval, k=k),
        format,
        output,
        PartnerRules(other_cameras, sequential, own_pairs, across),
        connect,
        export,
    )
    if as_json:
        print_json(as_dictionary(report))
    else:
        say(*summary(project, report))
    finish_partial(report.ranking.left_out_lines())


@cli.command()
@written_project_options
@matching_options
@json_option
@verbose_option
@cluster_option
def match(
    project: Project,
    pairs: Path | None,
    rounds: RoundsOptions | None,
    matching: MatchOptions,
    as_json: bool,
) -> None:
    """Match and verify the pairs of a list, or spend a budget of pairs in --rounds.

    This writes matches into the database, where COLMAP keeps them (--copy does not); one of
    COLMAP 3.x is brought to the schema of COLMAP 4. A stopped run goes on where it stopped.
    """
    from colmap_netvlad.commands.match import as_json as as_dictionary
    from colmap_netvlad.commands.match import match as run
    from colmap_netvlad.commands.match import report_lines

    report = run(project, pairs, rounds, matching)
    if as_json:
        print_json({**as_dictionary(report), "database": project.database})
        return
    say(*report_lines(report))
    click.echo(f"Matches are in {project.database}.")


@cli.command()
@written_project_options
@output_option(
    help="Folder of the models.  [default: sparse beside the database; sparse-2, sparse-3, ..."
    " where there are models already]",
)
@mapping_options
@contradicted_option
@place_options
@ground_options
@matching_options
@json_option
@verbose_option
@cluster_option
def reconstruct(
    project: Project,
    pairs: Path | None,
    rounds: RoundsOptions | None,
    matching: MatchOptions,
    output: Path | None,
    mapper: str,
    mapping: MappingOptions,
    drop_contradicted: bool,
    world: WorldOptions,
    gcp: ControlFile | None,
    as_json: bool,
) -> None:
    """Match the pairs, verify them, and build the sparse model.

    This writes matches into the database, where COLMAP keeps them (--copy does not); one of
    COLMAP 3.x is brought to the schema of COLMAP 4. Pairs matched before are not matched again,
    so a stopped run goes on where it stopped.
    """
    from colmap_netvlad.commands.reconstruct import ReconstructOptions, check_mapper, report_lines
    from colmap_netvlad.commands.reconstruct import as_json as as_dictionary
    from colmap_netvlad.commands.reconstruct import reconstruct as run
    from colmap_netvlad.terminal import print_models

    check_mapper(mapper, use_gps=world.use_gps)
    options = ReconstructOptions(
        mapper,
        replace(mapping, seed=matching.seed),
        matching,
        replace(world, gcp=gcp),
        drop_contradicted,
        given_command(),
    )
    report = run(project, pairs, output, options, rounds)
    if as_json:
        print_json({**as_dictionary(report), "database": project.database})
        return
    print_models(report)
    say(*report_lines(report))
    click.echo(f"Matches are in {project.database}, models in {report.output}.")
    say_verdict(report.quality)


@cli.command()
@project_options
@click.option(
    "--sparse",
    type=PATH,
    help="Folder of the model to extend.  [default: the largest in sparse, or in the newest"
    " sparse-N]",
)
@output_option(
    help="Folder of the extended model.  [default: the next sparse-N beside the database]"
)
@click.option("--among-new", is_flag=True, help="Pair the new photos with each other as well.")
@k_option
@method_option
@retrieval_options
@matcher_options
@contradicted_option
@feature_options
@verbose_option
def add(
    project: Project,
    sparse: Path | None,
    output: Path | None,
    among_new: bool,
    k: int,
    method: str,
    retrieval: RetrievalOptions,
    matching: MatchOptions,
    drop_contradicted: bool,
    features: FeatureOptions,
) -> None:
    """Register new photos into an existing model.

    Copy them beside the old ones first. This writes the database: features and matches of the new
    photos. Only what is new is computed: a new photo is paired with its k most likely partners
    among the old ones. The old model is left as it is, the extended one is written beside it. Give
    the SIFT settings that the old photos were imported with.
    """
    from colmap_netvlad.commands.add import AddOptions, add_lines, add_photos

    options = AddOptions(
        method,
        replace(retrieval, k=k),
        among_new,
        replace(features, masks=retrieval.masks),
        retrieval.seed,
        matching,
        drop_contradicted,
        given_command(),
    )
    report = add_photos(project, sparse, options, output)
    say(*add_lines(report))
    say_verdict(report.quality)
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.features.bad])


@cli.command()
@sparse_option
@model_database_option
@model_images_option
@output_option(help="The page.  [default: report.html in the model's folder]")
@verbose_option
def report(sparse: Path, database: Path | None, images: Path | None, output: Path | None) -> None:
    """Write the quality report of a model as one page, and say the verdict.

    Database and photos are only read; what is missing (database, photos, GPS) the page says.
    `reconstruct` and `add` write it beside every model they make.
    """
    from colmap_netvlad.commands.report import report as run

    say_verdict([run(sparse, database, images, output)])


def say_verdict(reports: Sequence[FlightReport]) -> None:
    """Print the verdict on the largest model, and where the pages of smaller ones are."""
    say(*(reports[0].lines if reports else ()))
    say(*(f"Report of a smaller model: {other.page}" for other in reports[1:]))


def given_command() -> str:
    """Return the command as the user gave it."""
    return command_line(["colmap-netvlad", *sys.argv[1:]])


@cli.command()
@sparse_option
@model_database_option
@model_images_option
@output_option(
    help="Folder of the models in the world.  [default: the given one's name + -georegistered]"
)
@ground_options
@seed_option
@verbose_option
def georegister(
    sparse: Path,
    database: Path | None,
    images: Path | None,
    output: Path | None,
    gcp: ControlFile | None,
    seed: int,
) -> None:
    """Bring any COLMAP model into the world: m east, north, up of a stated origin.

    The model is aligned robustly to position priors of a database, to EXIF GPS or to ground
    points, and written to a new folder, with georeference.json (origin, EPSG code of the UTM zone,
    transform, residuals) in it. A database is not needed: the photos' GPS is enough.
    """
    from colmap_netvlad.commands.georegister import database_beside, images_beside, report_lines
    from colmap_netvlad.commands.georegister import georegister as run

    database, of_database = database_beside(sparse, database)
    images, of_images = images_beside(sparse, images)
    say(*of_database, *of_images)
    report = run(sparse, output, database, images, gcp, seed)
    say(*report_lines(report))
    finish_partial(
        [f"Left out: {one.name}: {one.fault}" for one in report.models if one.georeference is None]
    )


@cli.command()
@sparse_option
@model_database_option
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
@output_option(help="A new folder.  [default: the model's name + -export]")
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
    from colmap_netvlad.commands.export import report_lines
    from colmap_netvlad.commands.georegister import database_beside

    database, of_database = database_beside(sparse, database)
    say(*of_database)
    say(*report_lines(run(sparse, formats, output, database, crs)))


@cli.command()
@project_options
@click.option(
    "--sparse",
    type=PATH,
    multiple=True,
    required=True,
    help="A COLMAP model, or a folder of models 0, 1, ...; given twice or more.",
)
@output_option(help="Folder of the models.  [default: the next sparse-N beside the database]")
@click.option(
    "--across",
    type=click.IntRange(min=1),
    default=10,
    show_default=True,
    help="Partners in other models that each image is matched with.",
)
@method_option
@retrieval_options
@verbose_option
def merge(
    project: Project,
    sparse: tuple[Path, ...],
    output: Path | None,
    across: int,
    method: str,
    retrieval: RetrievalOptions,
) -> None:
    """Put models of one project together: several flights, days or heights.

    Pairs across the models are retrieved, matched and verified (this writes the database); one
    similarity is solved for all models at once, then all is adjusted together. Models that cannot
    be joined stay and are named.
    """
    from colmap_netvlad.commands.merge import MergeOptions, merge_lines, merge_models

    options = MergeOptions(method, retrieval, across)
    say(*merge_lines(merge_models(project, sparse, output, options)))


@cli.command()
@database_option
@click.option(
    "--graphml", type=FILE, help="Also write the graph for Gephi, yEd or Cytoscape (GraphML)."
)
@json_option
def viewgraph(database: Path | None, graphml: Path | None, as_json: bool) -> None:
    """Show how well the verified pairs hold the flight together.

    Components, images per pair, and the images and pairs whose loss splits the model. The
    database stays as it is.
    """
    from colmap_netvlad.graph.viewgraph import read_view_graph, statistics_lines
    from colmap_netvlad.project import locate_database

    graph = read_view_graph(locate_database(database))
    if graphml is not None:
        graph.write_graphml(graphml)
    statistics = graph.statistics()
    if as_json:
        print_json(statistics)
    else:
        say(*statistics_lines(statistics))
        if graphml is not None:
            say(f"The graph is in {graphml}.")


@cli.command()
@json_option
def methods(as_json: bool) -> None:
    """List the retrieval methods and their sources."""
    from colmap_netvlad.retrieval.methods import METHODS

    if as_json:
        rows = [{"name": m.name, "summary": m.summary, "needs": m.needs} for m in METHODS.values()]
        print_json(rows)
        return
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
@click.option(
    "--photos",
    type=int,
    help="Photos of the flight, 4 to 9,999, over a country of roofs, car parks, orchards, fields"
    " and ponds that grows with them.  [default: 42 over a village]",
)
@seed_option
@verbose_option
def demo(output: Path, method: str | None, photos: int | None, seed: int) -> None:
    """Render a drone flight, reconstruct it, and check the result against the truth.

    Takes about two minutes; with --photos about three for every 100 of them, on two processors, and
    some 2 GB of memory for drawing the ground. Exit code 1 where a photo is not registered, or a
    camera centre is off by more than 1 % of the flight's extent.
    """
    from colmap_netvlad.commands.demo import DEMO_FLIGHT, run_demo
    from colmap_netvlad.commands.reconstruct import ReconstructReport
    from colmap_netvlad.demo.render import FlightOptions
    from colmap_netvlad.models.catalogue import DEFAULT
    from colmap_netvlad.terminal import print_models

    def tell(item: str | ReconstructReport) -> None:
        if isinstance(item, str):
            say(item)
        else:
            print_models(item)

    flight = (
        replace(DEMO_FLIGHT, seed=seed)
        if photos is None
        else FlightOptions.large(photos, seed=seed)
    )
    if not run_demo(output, method or DEFAULT, flight, tell).passed:
        sys.exit(1)


@cli.command()
@project_options
@click.option(
    "--methods",
    default="bow,vlad,netvlad-o-lite",
    show_default=True,
    help="Methods, checkpoints and files of descriptors by path, with commas; `colmap-netvlad"
    " methods` lists them.",
)
@click.option(
    "--k",
    default="30",
    callback=numbers,
    show_default=True,
    help="Partners retrieved for each image, one number or several: 10,20,30.",
)
@retrieval_options
@matcher_options
@output_option(
    help="Folder of the comparison.  [default: <database>-compare beside the database]",
)
@click.option(
    "--reconstruct/--no-reconstruct",
    default=True,
    help="Make each method's model, or stop after matching.  [default: make it]",
)
@click.option(
    "--reconstruct-k", type=int, help="Which of --k the models are made from.  [default: largest]"
)
@click.option(
    "--yes", "confirm", is_flag=True, help="Do not ask before a long exhaustive matching."
)
@verbose_option
@cluster_option
def compare(
    project: Project,
    methods: str,
    k: tuple[int, ...],
    retrieval: RetrievalOptions,
    matching: MatchOptions,
    output: Path | None,
    reconstruct: bool,
    reconstruct_k: int | None,
    confirm: bool,
) -> None:
    """Compare retrieval methods on your own flight, and write a report page.

    Each method starts from the features of the database, which is only read; all work is done on
    copies in the comparison's folder. Pairs that several methods ask for are matched once. A
    killed run goes on where it stopped, and methods can be added in a later run. A method that
    fails is listed at the end, the others finish (exit code 3).
    """
    from colmap_netvlad.commands.compare import CompareOptions
    from colmap_netvlad.commands.compare import compare as run
    from colmap_netvlad.terminal import print_comparison

    def ask(question: str) -> bool:
        return confirm or (sys.stdin.isatty() and click.confirm(question, err=True))

    options = CompareOptions(
        k=k,
        output=output,
        reconstruct=reconstruct,
        reconstruct_k=reconstruct_k,
        retrieval=retrieval,
        seed=retrieval.seed,
        matching=matching,
    )
    names = [name.strip() for name in methods.split(",") if name.strip()]
    report = run(project, names, options, ask)
    print_comparison(report.comparison)
    click.echo(f"Report: {report.page} (figures: {report.json.name}, {report.csv.name})")
    finish_partial([f"Not finished: {sentence}" for sentence in report.comparison.incomplete])


@cli.command()
@click.argument("datasets", nargs=-1, required=True, type=PATH)
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
@retrieval_options
@click.option(
    "--mapper",
    default="incremental",
    show_default=True,
    help="Mapping method; none: tracks of verified matches stand for 3D points (fast, no poses).",
)
@verbose_option
def annotate(
    datasets: tuple[Path, ...],
    output: Path | None,
    databases: Path | None,
    method: str,
    k: int,
    retrieval: RetrievalOptions,
    mapper: str,
) -> None:
    """Annotate scenes for training: which photos see the same 3D points.

    DATASETS are folders of scenes (<scene>/images, or photos right in <scene>), or single scenes.
    Each scene is reconstructed; the number of common 3D points of its photos (GS) is saved as
    annotation.npz. Scenes annotated before are passed over.
    """
    from colmap_netvlad.commands import annotate as annotation

    options = annotation.AnnotateOptions(method, replace(retrieval, k=k), output, databases, mapper)
    report = annotation.annotate(datasets, options)
    say(*annotation.table_lines(report.scenes))
    finish_partial(report.left_out)


@cli.command(cls=SettingsCommand)
@click.argument("datasets", nargs=-1, required=True, type=PATH)
@click.option(
    "--output", type=FOLDER, required=True, help="Folder of the run; an unfinished one goes on."
)
@click.option(
    "--validation",
    multiple=True,
    type=PATH,
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
    `--model`, the training curves, and a checkpoint that a stopped run goes on from. The paper
    shows photos as they are; here they are turned, cut and lit at random, unless `--upright 1`.
    """
    from colmap_netvlad.cli_settings import settings_of
    from colmap_netvlad.training.run import report_lines
    from colmap_netvlad.training.run import train as run
    from colmap_netvlad.training.scenes import load_dataset

    options = settings_of(context, recipe)
    measured = load_dataset(validation)
    scenes = load_dataset(datasets, leave_out, measured)
    report = run(scenes, measured, options, output, device=device, name=name)
    say(*report_lines(report))
    finish_partial(report.left_out)


def print_json(report: Any) -> None:
    """Print a report as JSON on standard output."""
    click.echo(json.dumps(plain(report), indent=1, ensure_ascii=False))


def finish_partial(left_out: list[str]) -> None:
    """List on standard error what a finished command left out, and exit with EXIT_PARTIAL."""
    if not left_out:
        return
    say(*left_out, err=True)
    sys.exit(EXIT_PARTIAL)


def main() -> None:
    """Run the command line: the entry point `colmap-netvlad`. SIGTERM stops it as Ctrl-C does."""
    hear_interrupts()
    cli()


if __name__ == "__main__":
    main()
