"""From merged sub-models to a COLMAP model: adjusted together, missed images registered."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.colmap import engine
from colmap_netvlad.mapping.merge import SubModel

MIN_NUM_MATCHES = 15
"""Verified matches a pair needs to be used: the default of COLMAP's mappers."""

ROBUST_ITERATIONS = 20
"""Iterations of a robust bundle adjustment, which need not converge: with 50 instead, the errors of
a corridor of 300 photos with RTK are the same to a tenth of a millimetre."""

DIRECT_IMAGES = 5000
"""Up to this many images the sparse direct solver is used; COLMAP changes to an iterative one at
1,000, which took about five times as long on a simulated flight of 2,000: photos of a flight see
few others, so the system is sparse."""

MAX_REFINEMENTS = 3
"""Rounds of bundle adjustment and filtering of the merged model; they stop when little changes."""


def load_cache(database: Path) -> pycolmap.DatabaseCache:
    """Load what mapping needs of a whole database."""
    with engine.opened(database) as opened:
        options = pycolmap.DatabaseCacheOptions(min_num_matches=MIN_NUM_MATCHES)
        return pycolmap.DatabaseCache.create(opened, options)


def rebuild(model: SubModel, cache: pycolmap.DatabaseCache) -> pycolmap.Reconstruction:
    """Turn arrays into a reconstruction over the images of a database.

    Each camera of the database is one camera of the model, whatever sub-models it was in.
    """
    reconstruction = pycolmap.Reconstruction()
    reconstruction.load(cache)
    for camera_id, (params, _) in model.cameras.items():
        reconstruction.camera(camera_id).params = params.tolist()
    for rig_id, rig in model.rigs.items():
        if reconstruction.exists_rig(rig_id):
            for sensor, pose in rig.non_ref_sensors.items():
                if pose is not None:
                    reconstruction.rig(rig_id).set_sensor_from_rig(sensor, pose)
    for image_id in sorted(model.poses):
        image = reconstruction.image(image_id)
        frame = reconstruction.frame(image.frame_id)
        if not frame.has_pose():
            frame.set_cam_from_world(image.camera_id, model.poses[image_id])
            reconstruction.register_frame(image.frame_id)
    order = np.argsort(model.owner, kind="stable")
    ends = np.cumsum(np.bincount(model.owner, minlength=len(model.xyz)))
    keys = model.keys[order]
    images, keypoints = (keys >> 32).tolist(), (keys & 0xFFFFFFFF).tolist()
    start = 0
    for xyz, color, end in zip(model.xyz, model.color, ends.tolist(), strict=True):
        elements = [
            pycolmap.TrackElement(image, keypoint)
            for image, keypoint in zip(images[start:end], keypoints[start:end], strict=True)
        ]
        reconstruction.add_point3D(xyz, pycolmap.Track(elements), color)
        start = end
    return reconstruction


def refine(
    reconstruction: pycolmap.Reconstruction,
    cache: pycolmap.DatabaseCache,
    options: pycolmap.IncrementalPipelineOptions,
    reached: Callable[[float], None],
    *,
    triangulate: bool = False,
) -> None:
    """Adjust a merged model and register the images it misses, in place.

    A first bundle adjustment with a robust loss takes up the seams between sub-models before
    anything is filtered; tracks are then completed and merged across them.

    Args:
        reached: told the share of the work that is done, 0..1, as far as it is known.
        triangulate: look for new points in every image: sub-models that share no image have none
            yet where only images of several see a place.
    """
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    adjust_robustly(mapper, options, pycolmap.LossFunctionType.CAUCHY)
    if triangulate:
        for image_id in reconstruction.reg_image_ids():
            mapper.triangulate_image(options.get_triangulation(), image_id)
    reached(0.3)
    _refine_globally(mapper, options)
    reached(0.9)
    _register_missed(mapper, cache, options)
    mapper.end_reconstruction(False)
    reconstruction.update_point_3d_errors()
    reached(1.0)


def _refine_globally(
    mapper: pycolmap.IncrementalMapper, options: pycolmap.IncrementalPipelineOptions
) -> None:
    mapper.iterative_global_refinement(
        MAX_REFINEMENTS,
        options.ba_global_max_refinement_change,
        options.get_mapper(),
        bundle_options(options),
        options.get_triangulation(),
        normalize_reconstruction=not options.use_prior_position,
    )
    mapper.filter_frames(options.get_mapper())


def _register_missed(
    mapper: pycolmap.IncrementalMapper,
    cache: pycolmap.DatabaseCache,
    options: pycolmap.IncrementalPipelineOptions,
) -> None:
    """Register the images that the model misses, in the order of COLMAP's incremental pipeline.

    The pipeline itself adjusts everything once more even where nothing can be registered, and
    above 1,000 images with the iterative solver.
    """
    model = mapper.reconstruction
    pipeline = pycolmap.IncrementalPipeline(options, cache, pycolmap.ReconstructionManager())
    adjusted = model.num_reg_images(), model.num_points3D()
    while True:
        found = _register_next(mapper, options)
        if not found and model.num_reg_images() <= adjusted[0]:
            return
        if not found or pipeline.check_run_global_refinement(model, *adjusted):
            _refine_globally(mapper, options)
            adjusted = model.num_reg_images(), model.num_points3D()


def _register_next(
    mapper: pycolmap.IncrementalMapper, options: pycolmap.IncrementalPipelineOptions
) -> bool:
    """Register one image, its points and its surroundings; whether there was one."""
    settings, triangulation = options.get_mapper(), options.get_triangulation()
    for structure_less, register in (
        (False, mapper.register_next_image),
        (True, mapper.register_next_structure_less_image),
    ):
        for image_id in mapper.find_next_images(settings, structure_less):
            if register(settings, image_id):
                frame = mapper.reconstruction.image(image_id).frame
                assert frame is not None
                for seen in frame.image_ids:
                    mapper.triangulate_image(triangulation, seen.id)
                mapper.iterative_local_refinement(
                    options.ba_local_max_refinements,
                    options.ba_local_max_refinement_change,
                    settings,
                    options.get_local_bundle_adjustment(),
                    triangulation,
                    image_id,
                )
                return True
    return False


def adjust_robustly(
    mapper: pycolmap.IncrementalMapper,
    options: pycolmap.IncrementalPipelineOptions,
    loss: pycolmap.LossFunctionType,
) -> None:
    """Adjust a mapper's whole model with a robust loss on reprojection errors of 1 px and more."""
    bundle = bundle_options(options)
    bundle.ceres.loss_function_type = loss
    bundle.ceres.solver_options.max_num_iterations = ROBUST_ITERATIONS
    mapper.adjust_global_bundle(options.get_mapper(), bundle)


def bundle_options(
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.BundleAdjustmentOptions:
    """Return COLMAP's options of global bundle adjustment with the solver for flights."""
    bundle = options.get_global_bundle_adjustment()
    bundle.ceres.max_num_images_direct_sparse_cpu_solver = DIRECT_IMAGES
    return bundle
