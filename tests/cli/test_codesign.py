"""`torchmask codesign`: what it makes of its scene. The whole experiment is tested in tests/experiments."""

from torchmask.cli.codesign import Options, scene_knee
from torchmask.simulation.scene import SceneOptions


def test_the_spectrum_of_a_scene_has_its_knee_at_one_over_its_side_and_of_a_point_none():
    for size, knee in ((0.5, 2 / Options().imaging.n_pixels), (1e-3, 0.5)):
        assert scene_knee(Options(scene=SceneOptions(size=size))) == knee
