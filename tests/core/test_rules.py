"""What holds in every step of the core: many more of the hostile histories that both builds run."""

from histories import hostile

from tormagd.control.assembly.build import Core


def test_no_hostile_history_breaks_a_rule(core: Core) -> None:
    hostile(core, lambda _: None, episodes=270)
