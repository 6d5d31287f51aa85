"""The conversation with the firmware: who it is, what it was asked, and positions without wrap-around."""

import math

import pytest
from hypothesis import given, strategies as st

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    Switches,
    decode,
    encode,
    period,
)
from tormagd.hardware.link import (
    FIRST_NONCE,
    GIVE_UP_S,
    HELLO_S,
    OVERTAKEN,
    REPEAT_S,
    UNANSWERED_S,
    DeviceLink,
    LinkState,
)
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.hardware.measurement import DeviceRequest, Measurement

US = Identity(SCHEMA_HASH, 1, 2, 77)
POSITION_SPAN_MM = period(State, "left_position_mm")
TIME_SPAN_S = period(State, "device_time_s")
HANDLE_SPAN_MM = period(Sense, "handle_position_mm")


def status(nonce: int = 0, **changes: object) -> Status:
    return Status(DeviceMode.IDLE, Switches.HOMED, DeviceFault(0), 23.0, 12.0, 0, nonce).replaced(**changes)  # type: ignore[arg-type]


def running(nonce: int = 0) -> DeviceLink:
    link = DeviceLink(0.0)
    assert [type(message) for message in link.due(0.0)] == [Hello]
    told(link, 0.0, US, status(nonce), Sense(0.0, 0.0, 0.0, 0.0), State(0.0, 0.0, 0.0, 0))
    assert link.state is LinkState.RUNNING
    return link


@pytest.fixture
def link() -> DeviceLink:
    return running()


@pytest.fixture
def unmet() -> DeviceLink:
    return DeviceLink(0.0)


def told(link: DeviceLink, now_s: float, *messages: Message) -> None:
    for message in messages:
        link.receive(now_s, message)


def due(link: DeviceLink, from_s: float, until_s: float, heard: bool = True) -> list[tuple[float, Message]]:
    sent = []
    for tick in range(round(from_s * 1e3), round(until_s * 1e3)):
        now_s = tick * 1e-3
        if heard:
            link.receive(now_s, Sense(0.0, 0.0, 0.0, 0.0))
        sent += [(now_s, message) for message in link.due(now_s)]
    return sent


# -- who it is -----------------------------------------------------------------------------------------------------


def test_hello_is_said_until_somebody_answers_and_then_now_and_again(unmet: DeviceLink) -> None:
    hello = Hello(SCHEMA_HASH, PROTOCOL_VERSION, FIRST_NONCE)
    asking = due(unmet, 0.0, 0.32)
    assert [message for _, message in asking] == [hello] * len(asking)
    assert [at_s for at_s, _ in asking] == pytest.approx([k * REPEAT_S for k in range(7)], abs=8e-3)
    assert unmet.state is LinkState.IDENTIFYING
    unmet.receive(0.32, US)
    assert unmet.state is LinkState.RUNNING
    later = due(unmet, 0.32, 0.45 + 3.0 * HELLO_S)
    assert [message for _, message in later] == [hello] * 4
    assert later[2][0] - later[1][0] == pytest.approx(HELLO_S, abs=2e-3)


def test_a_device_that_turns_up_late_is_no_loss_and_asked_at_its_first_word(unmet: DeviceLink) -> None:
    due(unmet, 0.0, UNANSWERED_S, heard=False)
    assert unmet.state is LinkState.IDENTIFYING
    late = due(unmet, UNANSWERED_S, 10.3, heard=False)
    assert (unmet.state, len(late)) == (LinkState.UNANSWERED, pytest.approx(9.0 / HELLO_S, abs=1))
    unmet.receive(10.3, status())
    assert (unmet.state, [type(message) for message in unmet.due(10.3)]) == (LinkState.IDENTIFYING, [Hello])


def test_a_device_that_was_reset_has_to_say_again_who_it_is() -> None:
    link = running(nonce=FIRST_NONCE)
    link.receive(0.02, status(0, switches=Switches(0)))
    assert link.state is LinkState.RUNNING, "the core sees first what the reset did"
    assert not link.measurement.is_homed
    link.request(0.021, DeviceRequest.RETRACT)
    assert [type(message) for message in link.due(0.021)] == [Hello]
    assert (link.state, link.measurement) == (LinkState.IDENTIFYING, None)
    assert "reset" in link.cause
    told(link, 0.0215, status(), US.replaced(schema_hash=SCHEMA_HASH ^ 1))
    assert link.due(0.0215) == [], "nothing is asked of a device that does not fit"
    told(link, 0.022, US, status(FIRST_NONCE), Sense(0.0, 0.0, 0.0, 0.0), State(5.0, 5.0, 0.0, 1))
    assert (link.state, link.measurement.left_mm) == (LinkState.RUNNING, 5.0)
    assert [type(message) for message in link.due(0.022)] == [Retract], "opening is still wanted"


@pytest.mark.parametrize("request_", [DeviceRequest.HOME, DeviceRequest.CLEAR])
def test_a_reset_device_does_nothing_that_was_asked_of_it_before(request_: DeviceRequest) -> None:
    link = running(nonce=FIRST_NONCE)
    link.request(0.01, request_)
    link.receive(0.02, status(0))
    link.due(0.02)
    told(link, 0.03, US, status(FIRST_NONCE))
    assert (link.pending, {type(message) for _, message in due(link, 0.03, 2.0)}) == (DeviceRequest.NONE, {Hello})


def test_another_device_at_the_same_line_is_not_taken_for_the_first() -> None:
    link = running(nonce=FIRST_NONCE)
    link.receive(1.0, US.replaced(serial_number=78))
    link.due(1.001)
    assert (link.state, link.measurement) == (LinkState.IDENTIFYING, None)
    assert "77 was replaced by device 78" in link.cause


@pytest.mark.parametrize("behind", [0, 1, OVERTAKEN - 1])
def test_a_state_that_is_no_news_measures_nothing(behind: int, link: DeviceLink) -> None:
    link.receive(0.1, State(-1.0, -1.0, 0.1, 40))
    before = link.measurement
    link.receive(0.2, State(-9.0, -9.0, 0.05, 40 - behind))
    assert (link.measurement is before, link.repeated) == (True, 1)
    link.receive(0.3, State(-1.5, -1.5, 0.3, 40 + 3))
    assert link.measurement.left_mm == pytest.approx(-1.5)


def test_a_repetition_is_none_the_less_one_before_the_device_is_known(unmet: DeviceLink) -> None:
    told(unmet, 0.0, US, State(0.0, 0.0, 0.0, 5), Sense(0.0, 0.0, 0.0, 0.0), status(), State(0.0, 0.0, 0.0, 5))
    assert (unmet.measurement, unmet.repeated) == (None, 1)
    unmet.receive(0.001, State(0.0, 0.0, 0.0, 6))
    assert unmet.measurement is not None


# -- what it was asked ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "kind"),
    [(DeviceRequest.HOME, Home), (DeviceRequest.RETRACT, Retract), (DeviceRequest.CLEAR, Clear)],
)
def test_a_command_is_repeated_until_its_own_number_comes_back(
    request_: DeviceRequest, kind: type[Message], link: DeviceLink
) -> None:
    link.request(1.0, request_)
    sent = due(link, 1.0, 1.23)
    assert {type(message) for _, message in sent} == {kind}
    assert len({message.nonce for _, message in sent}) == 1  # type: ignore[union-attr]
    assert [at_s for at_s, _ in sent] == pytest.approx([1.0 + k * REPEAT_S for k in range(5)], abs=5e-3)
    nonce = sent[0][1].nonce  # type: ignore[union-attr]
    link.receive(1.23, status((nonce + 1) % 256))
    assert kind in {type(message) for _, message in due(link, 1.23, 1.3)}
    link.receive(1.3, status(nonce))
    assert kind not in {type(message) for _, message in due(link, 1.3, 2.5)}


def test_no_hello_comes_between_a_command_and_its_acknowledgement(link: DeviceLink) -> None:
    link.request(0.5, DeviceRequest.HOME)
    waiting = due(link, 0.5, 0.5 + GIVE_UP_S)
    assert all(isinstance(message, Home) for _, message in waiting)
    nonce = waiting[0][1].nonce  # type: ignore[union-attr]
    link.receive(0.5 + GIVE_UP_S, status(nonce))
    assert {message for _, message in due(link, 3.0, 5.0)} == {Hello(SCHEMA_HASH, PROTOCOL_VERSION, nonce)}
    link.request(5.0, DeviceRequest.RETRACT)
    link.receive(5.0, status(nonce))
    assert any(isinstance(message, Retract) for _, message in due(link, 5.0, 5.1))


@pytest.mark.parametrize("request_", [DeviceRequest.HOME, DeviceRequest.CLEAR])
def test_a_command_that_the_device_does_not_take_is_given_up(request_: DeviceRequest, link: DeviceLink) -> None:
    link.request(0.0, request_)
    assert len(due(link, 0.0, GIVE_UP_S)) == pytest.approx(GIVE_UP_S / REPEAT_S, abs=1)
    assert {type(message) for _, message in due(link, GIVE_UP_S + 2e-3, 4.0)} == {Hello}
    assert link.pending is DeviceRequest.NONE


def test_opening_is_asked_for_until_the_device_opens_or_has_latched(link: DeviceLink) -> None:
    link.request(0.0, DeviceRequest.RETRACT)
    assert {type(message) for _, message in due(link, 0.0, 5.0)} == {Retract}
    link.receive(5.0, status(mode=DeviceMode.RETRACTING))
    assert link.pending is DeviceRequest.RETRACT
    link.receive(5.02, status(mode=DeviceMode.LATCHED))
    assert (link.pending, {type(message) for _, message in due(link, 5.02, 7.0)}) == (DeviceRequest.NONE, {Hello})


def test_every_request_has_a_new_number_and_none_is_zero_or_a_hellos(link: DeviceLink) -> None:
    last = 0
    for turn in range(600):
        link.request(turn * 0.1, DeviceRequest.HOME)
        link.receive(turn * 0.1, status(last))
        (nonce,) = [message.nonce for message in link.due(turn * 0.1) if isinstance(message, Home)]
        assert last != nonce in range(1, FIRST_NONCE)
        last = nonce
        link.receive(turn * 0.1, status(nonce))


@pytest.mark.parametrize("left_by_another_host", [0, 1, 2, 254, 255])
@pytest.mark.parametrize("is_early", [False, True], ids=["after the first Status", "before it"])
def test_a_number_that_another_host_used_last_is_no_acknowledgement(
    left_by_another_host: int, is_early: bool, unmet: DeviceLink
) -> None:
    if is_early:
        unmet.request(0.0, DeviceRequest.RETRACT)
        assert not any(isinstance(message, Retract) for message in unmet.due(0.0))
    told(unmet, 0.0, US, status(left_by_another_host))
    if not is_early:
        unmet.request(0.0, DeviceRequest.RETRACT)
    unmet.receive(0.01, status(left_by_another_host))
    (retract,) = [message for _, message in due(unmet, 0.01, 0.05) if isinstance(message, Retract)]
    assert retract.nonce not in (0, left_by_another_host)


def test_a_device_that_has_homed_is_homed_from_the_first_position_in_its_new_origin(unmet: DeviceLink) -> None:
    homing = status(mode=DeviceMode.HOMING, switches=Switches(0))
    told(unmet, 0.0, US, homing, Sense(0.0, 0.0, 0.0, 0.0), State(7.5, 8.5, 0.0, 0))
    unmet.receive(0.001, status(switches=Switches.LEFT_OPEN | Switches.RIGHT_OPEN | Switches.HOMED))
    before = unmet.measurement
    assert (before.is_homed, before.is_busy, before.left_mm) == (False, True, 7.5)
    unmet.receive(0.001, State(0.1, 0.2, 0.001, 1))
    after = unmet.measurement
    assert (after.is_homed, after.is_busy, after.left_mm, after.right_mm) == (
        True,
        False,
        pytest.approx(0.1),
        pytest.approx(0.2),
    )


# -- what it measured ----------------------------------------------------------------------------------------------


def test_a_measurement_takes_a_status_a_sense_and_a_state(unmet: DeviceLink) -> None:
    unmet.receive(0.0, US)
    for message in (State(0.0, 0.0, 0.0, 0), Sense(0.1, 0.2, 0.3, 0.0), State(0.0, 0.0, 0.0, 1)):
        unmet.receive(0.1, message)
        assert unmet.measurement is None
    unmet.receive(0.2, status(supply_V=11.5))
    unmet.receive(0.7, State(-3.0, -4.0, 0.25, 2))
    measurement = unmet.measurement
    assert measurement == Measurement(
        0, 0.7, 0.25, -3.0, -4.0, 0.1, 0.2, 0.3, 0.0, DeviceMode.IDLE, Switches.HOMED, DeviceFault(0), 23.0, 11.5,
        0.1, 0.2,
    )  # fmt: skip
    assert unmet.measurement is measurement


def test_a_status_updates_what_it_knows_and_leaves_the_number(link: DeviceLink) -> None:
    before = link.measurement
    news = {"mode": DeviceMode.LATCHED, "switches": Switches(0), "faults": DeviceFault.SKEW, "temperature_C": 41.0}
    link.receive(1.0, status(**news))
    assert link.measurement == before.replaced(**news, reported_s=1.0)


NUMBERS = [
    *("received_s", "device_time_s", "left_mm", "right_mm", "left_current_A", "right_current_A", "force_N"),
    *("handle_mm", "temperature_C", "supply_V", "sensed_s", "reported_s", "delay_s", "round_trip_s", "clock_drift"),
]


def with_numbers(measurement: Measurement, numbers: dict[str, float]) -> Measurement:
    of_link = {name: number for name, number in numbers.items() if name in LinkQuality.__match_args__}
    own = {name: number for name, number in numbers.items() if name not in of_link}
    return measurement.replaced(**own, link=measurement.link.replaced(**of_link))


@pytest.mark.parametrize("name", NUMBERS)
def test_each_number_has_to_be_one_that_can_be_computed_with(name: str, link: DeviceLink) -> None:
    zero, sound = (with_numbers(link.measurement, dict.fromkeys(NUMBERS, number)) for number in (0.0, -2e9))
    assert (sound.is_finite, with_numbers(zero, {name: 1e10}).is_finite) == (True, True)
    assert not any(with_numbers(sound, {name: odd}).is_finite for odd in (1.1e10, -1.1e10, math.inf, math.nan))


@pytest.mark.parametrize(
    ("mode", "faults", "busy", "latched"),
    [
        (DeviceMode.IDLE, DeviceFault(0), False, False),
        (DeviceMode.RUN, DeviceFault(0), False, False),
        (DeviceMode.HOMING, DeviceFault(0), True, False),
        (DeviceMode.RETRACTING, DeviceFault.SUPPLY, True, True),
        (DeviceMode.LATCHED, DeviceFault(0), False, True),
    ],
)
def test_busy_and_latched(mode: DeviceMode, faults: DeviceFault, busy: bool, latched: bool, link: DeviceLink) -> None:
    told(link, 0.1, status(mode=mode, faults=faults))
    assert (link.measurement.is_busy, link.measurement.is_latched) == (busy, latched)


@pytest.mark.parametrize("switches", [Switches(bits) for bits in range(1 << 5)])
def test_each_switch_is_read_by_itself(switches: Switches) -> None:
    measurement = running().measurement.replaced(switches=switches)
    assert (measurement.is_left_open, measurement.is_right_open, measurement.is_homed) == (
        Switches.LEFT_OPEN in switches,
        Switches.RIGHT_OPEN in switches,
        Switches.HOMED in switches,
    )


def through_the_wire(message: Message) -> Message:
    return decode(FUNCTION[type(message)], encode(message))


@given(
    start=st.tuples(st.floats(-55.0, 55.0), st.floats(-55.0, 55.0), st.floats(0.0, 0.6), st.floats(0.0, 120.0)),
    moves=st.lists(
        st.tuples(
            st.floats(-0.45 * POSITION_SPAN_MM, 0.45 * POSITION_SPAN_MM),
            st.floats(-0.45 * POSITION_SPAN_MM, 0.45 * POSITION_SPAN_MM),
            st.floats(1e-4, 0.95 * TIME_SPAN_S),
            st.floats(-0.45 * HANDLE_SPAN_MM, 0.45 * HANDLE_SPAN_MM),
        ),
        max_size=30,
    ),
)
def test_wraps_are_taken_out(
    start: tuple[float, float, float, float], moves: list[tuple[float, float, float, float]]
) -> None:
    left, right, time_s, handle = start
    link = DeviceLink(0.0)
    told(link, 0.0, status(), *map(through_the_wire, (Sense(0.0, 0.0, 0.0, handle), State(left, right, time_s, 0))))
    first = link.measurement
    for number, (left_mm, right_mm, elapsed_s, handle_mm) in enumerate(moves, 1):
        left, right, time_s, handle = left + left_mm, right + right_mm, time_s + elapsed_s, handle + handle_mm
        news = (State(left, right, time_s, number % 256), Sense(0.0, 0.0, 0.0, handle))
        told(link, number * 1e-3, *map(through_the_wire, news))
    last = link.measurement
    assert (last.number, last.left_mm - first.left_mm, last.right_mm - first.right_mm) == (
        len(moves),
        pytest.approx(left - start[0], abs=2e-3),
        pytest.approx(right - start[1], abs=2e-3),
    )
    assert (last.device_time_s - first.device_time_s, last.handle_mm) == (
        pytest.approx(time_s - start[2], abs=2e-5),
        pytest.approx(handle - start[3], abs=8e-3),
    )


# -- each of its streams -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("heard", "refused", "missing"),
    [
        ((), {}, "no State yet, no Sense yet, no Status yet"),
        ((State(0.0, 0.0, 0.0, 1), status()), {}, "no Sense yet"),
        ((status(), State(0.0, 0.0, 0.0, 1)), {}, "no Sense yet"),
        ((Sense(0.0, 0.0, 0.0, 0.0), status()), {"State": "CRC-8"}, "State refused: CRC-8"),
        ((State(0.0, 0.0, 0.0, 1), Sense(0.0, 0.0, 0.0, 0.0)), {"State": "CRC-8"}, "no Status yet"),
    ],
)
def test_what_is_missing_for_a_measurement_is_said(heard, refused, missing: str, unmet: DeviceLink) -> None:
    assert not unmet.missing(refused), "it does not run yet"
    told(unmet, 0.01, US, *heard)
    assert (unmet.missing(refused), unmet.measurement) == (missing, None)


def test_the_quality_goes_with_the_measurement(link: DeviceLink) -> None:
    for tick in range(1, 1_500):
        now_s = tick * 1e-3
        link.drive(0.0, 0.0, DriveMode.OFF)
        if tick % 2:
            link.receive(now_s, State(0.0, 0.0, 0.0, tick // 2 % 256))
        link.judge(now_s, frames=tick, damaged=tick, unsent=tick // 10)
    measurement = link.measurement
    assert measurement.link.unanswered == pytest.approx(0.5, abs=0.01)
    assert (measurement.link.damaged, measurement.link.unsent) == pytest.approx((0.5, 0.1), abs=0.001)
