"""`benchmark scenes`: the contract's keys, the variants between the full model and the chosen one, and their front."""

import json

import benchmark
from benchmarks.scenes import Variant, front

from tormagd.scenes.scene import shipped_scenes

KEYS = {
    "name", "terms_in", "terms_out", "control_hz", "inference_hz", "solver", "rms_N", "rms_full_N", "tolerance_N",
    "cost_us_per_s", "cost_full_us_per_s",
}  # fmt: skip


def test_every_scene_has_the_keys_of_the_contract_and_its_variants(capsys, tmp_path):
    picture = tmp_path / "trade.png"
    assert benchmark.main(["scenes", "--json", "--plot", str(picture)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in result["scenes"]} <= set(shipped_scenes())
    for row in result["scenes"]:
        assert row.keys() >= KEYS
        first, *_, last = row["variants"]
        assert (first["cost_us_s"], first["rms_N"]) == (row["cost_full_us_per_s"], row["rms_full_N"])
        assert (last["cost_us_s"], last["rms_N"]) == (row["cost_us_per_s"], row["rms_N"])
        if row["terms_out"]:
            # the forecast works by the time: a scene that requires it saves less by slow rates than one that does not
            least = 1.8 if "forecast" in row["terms_in"] else 2.0
            assert row["cost_us_per_s"] < row["cost_full_us_per_s"] / least
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_on_the_front_nothing_is_both_cheaper_and_nearer():
    every = [Variant("a", 1.0, 5.0), Variant("b", 2.0, 6.0), Variant("c", 2.0, 3.0), Variant("d", 3.0, 3.0)]
    assert [each.name for each in front(every)] == ["a", "c"]
