"""What faces of a mesh reflect, by the colours in its file."""

import numpy as np
import pytest
import torch

from torchmask.simulation.render import load_mesh, render_mesh

trimesh = pytest.importorskip("trimesh")


@pytest.mark.parametrize(
    ("colour", "albedo"), [((255, 255, 255), 1.0), ((51, 51, 51), 0.2), ((255, 0, 0), 1 / 3), ((0, 102, 204), 0.4)]
)
def test_the_albedo_is_the_mean_of_the_colours_over_their_largest(tmp_path, colour, albedo):
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.visual.face_colors = np.array([*colour, 255], dtype=np.uint8)
    box.export(tmp_path / "box.ply")
    mesh = load_mesh(tmp_path / "box.ply")
    np.testing.assert_allclose(mesh.albedo, albedo, rtol=1e-12)
    # a face towards viewer and sun reflects its albedo, beside the light from all around
    image = render_mesh(mesh, 16, size=0.5, ambient=0.25)
    assert float(image.max()) == pytest.approx(1.25 * albedo, rel=1e-12)
    assert float(image.sum()) == pytest.approx(1.25 * albedo * 64, rel=1e-12)  # of 8 x 8 pixels
    assert image.dtype == torch.float64
