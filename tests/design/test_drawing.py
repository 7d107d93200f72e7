import math
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from torchmask.design.drawing import save_dxf, save_svg
from torchmask.design.manufacture import load_mask
from torchmask.optics.aperture import SparseAperture

SAVE = {".dxf": save_dxf, ".svg": save_svg}
SVG = "{http://www.w3.org/2000/svg}"


def masks():
    generator = torch.Generator().manual_seed(5)
    uneven = SparseAperture.random(7, 1 / 3, 0.12, generator).centers  # farther apart than the corners of hexagons
    return {
        "discs": SparseAperture(uneven, 0.1 / 3, 1 / 3),
        "hexagons": SparseAperture(uneven, 0.1 / 3, 1 / 3, shape="hexagon", orientation=2.1),
        "niriss": SparseAperture.from_catalog("niriss"),
    }


@pytest.mark.parametrize("name", masks())
@pytest.mark.parametrize("scale", [1000.0, 1.7])
def test_dxf_comes_back_to_a_nanometre(tmp_path, name, scale):
    mask = masks()[name]
    save_dxf(tmp_path / "mask.dxf", mask, scale=scale)
    back = load_mask(tmp_path / "mask.dxf")
    assert back.shape.name == mask.shape.name
    assert (back.centers - mask.centers).abs().max() * scale < 1e-6  # mm on the plate
    assert abs(back.subaperture_diameter - mask.subaperture_diameter) * scale < 1e-6
    assert abs(back.mask_diameter - mask.mask_diameter) * scale < 1e-6
    assert back.shape.parameters == pytest.approx(mask.shape.parameters, abs=1e-9)


@pytest.mark.parametrize("scale", [1000.0, 12.5])
def test_dxf_circles_as_another_program_reads_them(tmp_path, scale):
    """Millimetres on the plate, on the layers promised."""
    import ezdxf
    import ezdxf.units

    mask = masks()["discs"]
    save_dxf(tmp_path / "mask.dxf", mask, scale=scale)
    drawing = ezdxf.readfile(tmp_path / "mask.dxf")
    assert drawing.units == ezdxf.units.MM
    assert not drawing.audit().errors
    holes = drawing.modelspace().query('CIRCLE[layer=="HOLES"]')
    drawn = np.array([(c.dxf.center.x, c.dxf.center.y, c.dxf.radius) for c in holes])
    expected = np.column_stack(
        [mask.centers.numpy() * scale, np.full(mask.n_subapertures, mask.subaperture_diameter * scale / 2)]
    )
    np.testing.assert_allclose(drawn, expected, rtol=0, atol=1e-6)


def test_a_drawing_changed_in_cad_comes_back_changed(tmp_path):
    import ezdxf

    save_dxf(tmp_path / "mask.dxf", masks()["discs"])
    drawing = ezdxf.readfile(tmp_path / "mask.dxf")
    hole = next(iter(drawing.modelspace().query('CIRCLE[layer=="HOLES"]')))
    hole.dxf.center = (12.0, -7.0)
    drawing.saveas(tmp_path / "moved.dxf")
    assert load_mask(tmp_path / "moved.dxf").centers[0].tolist() == pytest.approx([0.012, -0.007], abs=1e-15)


@pytest.mark.parametrize("name", masks())
@pytest.mark.parametrize(("unit", "millimetres"), [("IN", 25.4), ("CM", 10.0), ("M", 1000.0), (None, 1.0)])
def test_a_drawing_converted_to_other_units_and_moved_is_the_same_mask(tmp_path, name, unit, millimetres):
    import ezdxf
    import ezdxf.units

    mask = masks()[name]
    save_dxf(tmp_path / "mask.dxf", mask, scale=1.25)
    drawing = ezdxf.readfile(tmp_path / "mask.dxf")
    for entity in drawing.modelspace():
        entity.scale_uniform(1 / millimetres)
        entity.translate(0.5, -7.0, 0.0)
    drawing.units = 0 if unit is None else getattr(ezdxf.units, unit)
    drawing.saveas(tmp_path / "converted.dxf")
    back = load_mask(tmp_path / "converted.dxf")
    assert (back.centers - mask.centers).abs().max() < 1e-9
    assert back.subaperture_diameter == pytest.approx(mask.subaperture_diameter, abs=1e-9)
    assert back.mask_diameter == pytest.approx(mask.mask_diameter, abs=1e-9)


def test_svg_is_in_millimetres_with_y_up(tmp_path):
    mask = masks()["discs"]
    save_svg(tmp_path / "mask.svg", mask, scale=30.0)
    root = ElementTree.parse(tmp_path / "mask.svg").getroot()
    assert root.get("width").endswith("mm")
    assert float(root.get("width")[:-2]) == pytest.approx(float(root.get("viewBox").split()[2]))
    circles = root.findall(f"{SVG}g[@id='holes']/{SVG}circle")
    drawn = np.array([[float(c.get(k)) for k in ("cx", "cy", "r")] for c in circles])
    np.testing.assert_allclose(drawn[:, :2], mask.centers.numpy() * [30, -30], rtol=1e-15)
    np.testing.assert_allclose(drawn[:, 2], mask.subaperture_diameter * 15, rtol=1e-15)


def test_svg_hexagons_have_the_width_and_orientation_of_the_mask(tmp_path):
    mask = SparseAperture(torch.tensor([[0.3, 0.1]], dtype=torch.float64), 0.2, 1.0, "hexagon", 0.2)
    save_svg(tmp_path / "mask.svg", mask, scale=1.0)
    polygon = ElementTree.parse(tmp_path / "mask.svg").getroot().find(f"{SVG}g/{SVG}polygon")
    corners = np.array([[float(v) for v in pair.split(",")] for pair in polygon.get("points").split()])
    corners = corners * [1, -1] - [0.3, 0.1]
    normals = np.array([[math.cos(0.2 + k * math.pi / 3), math.sin(0.2 + k * math.pi / 3)] for k in range(6)])
    np.testing.assert_allclose((corners @ normals.T).max(axis=0), 0.1, rtol=1e-13)


def test_drawings_that_are_no_mask_are_refused(tmp_path):
    import ezdxf

    def refuse(name, message, change):
        save_dxf(tmp_path / f"{name}.dxf", masks()["discs"])
        drawing = ezdxf.readfile(tmp_path / f"{name}.dxf")
        change(drawing, drawing.modelspace())
        drawing.saveas(tmp_path / f"{name}-changed.dxf")
        with pytest.raises(ValueError, match=message):
            load_mask(tmp_path / f"{name}-changed.dxf")

    def widen(_, plate):
        next(iter(plate.query('CIRCLE[layer=="HOLES"]'))).dxf.radius *= 1.01

    hole = {"layer": "HOLES"}
    refuse("unequal", "holes differ", widen)
    corners = [(math.cos(k * math.pi / 3), math.sin(k * math.pi / 3)) for k in range(6)]
    refuse("mixed", "all must be equal", lambda _, plate: plate.add_lwpolyline(corners, dxfattribs=hole))
    unknown = "corners is none of the known shapes"
    bent = [*corners[:5], (2, 0)]
    refuse("bent", f"6 {unknown}", lambda _, plate: plate.add_lwpolyline(bent, dxfattribs=hole))
    refuse("open", f"5 {unknown}", lambda _, plate: plate.add_lwpolyline(corners[:5], dxfattribs=hole))
    refuse("rims", "layer OUTLINE holds 2 circles", lambda _, plate: plate.add_circle((0, 0), 1, {"layer": "OUTLINE"}))
    refuse("sky", "the drawing is in Parsecs: set its unit", lambda drawing, _: setattr(drawing, "units", 20))
    refuse("scale", "does not give its scale", lambda drawing, _: drawing.header.custom_vars.clear())
    foreign = ezdxf.new()
    foreign.saveas(tmp_path / "foreign.dxf")
    with pytest.raises(ValueError, match="does not give its scale"):
        load_mask(tmp_path / "foreign.dxf")


@pytest.mark.parametrize("scale", [0.0, -1.0, math.inf, math.nan])
@pytest.mark.parametrize("suffix", [".dxf", ".svg"])
def test_bad_scales_are_refused(tmp_path, suffix, scale):
    with pytest.raises(ValueError, match=f"scale is {scale}"):
        SAVE[suffix](tmp_path / f"mask{suffix}", masks()["discs"], scale=scale)
