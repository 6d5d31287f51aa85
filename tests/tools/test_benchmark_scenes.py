"""`benchmark scenes`: the contract's keys, and what the chosen terms save."""

import json

import benchmark

from tormagd.scenes.scene import shipped_scenes

KEYS = {
    "name", "terms_in", "terms_out", "control_hz", "inference_hz", "solver", "rms_N", "rms_full_N", "tolerance_N",
    "cost_us_per_s", "cost_full_us_per_s",
}  # fmt: skip


def test_every_scene_has_the_keys_of_the_contract_and_saves_what_it_leaves_out(capsys):
    assert benchmark.main(["scenes", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in result["scenes"]} <= set(shipped_scenes())
    for row in result["scenes"]:
        assert row.keys() >= KEYS
        if row["terms_out"]:
            # the forecast works by the time: a scene that requires it saves less by slow rates than one that does not
            least = 1.8 if "forecast" in row["terms_in"] else 2.0
            assert row["cost_us_per_s"] < row["cost_full_us_per_s"] / least
