import json

import rank_masks


def test_the_catalogue_is_ranked_beside_masks_of_this_library(tmp_path, capsys):
    argv = ["--smoke", "--out", str(tmp_path / "run")]
    assert rank_masks.main(argv) == 0
    rows = json.loads((tmp_path / "run" / "ranking.json").read_text())["rows"]
    assert {row["mask"] for row in rows if row["layout"] == "searched"} == {"torchmask_3", "torchmask_6"}
    before = (tmp_path / "run" / "ranking.json").read_bytes()
    assert rank_masks.main(argv) == 1
    assert "exists and is not overwritten" in capsys.readouterr().err
    assert (tmp_path / "run" / "ranking.json").read_bytes() == before
