"""A guidewire in a bent vessel, computed by MuJoCo: the patient of a handle.

    python guidewire.py FOLDER [--seconds S] [--picture FILE.png] [--friction 0.2] [--stiffness-N-mm 0.1]
                        [--route LENGTH_MM:TURN_DEG,...]

FOLDER is where the sockets of an enabled daemon are. The handle, whose place 0 has the tip at the vessel's mouth, pushes
the wire onto an elastic lesion, BEHIND_MM before the route's end. The axial force at the wire's base, SCALE times as
large, is sent as a force until `ContactEstimator` knows the lesion, then as its wall. Robot and force follow with a lag
of FILTER_S each. The vessel is flat, and the wire a chain of hinges; more inertia than a real wire has, under 10 mN at a
hand's speed, keeps steps of 2 ms stable.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from tormagd_client import Client, ClientError
from tormagd_client.contact import ContactEstimator

STEP_S, FILTER_S = 2e-3, 0.02
SCALE = 3.0
SEGMENTS, SEGMENT_MM, WIRE_MM, VESSEL_MM, THICK_MM = 40, 5.0, 0.45, 1.8, 2.0
"The wire's segments, its radius, the vessel's, and that of the walls."
BENDING_N_MM2, FLOPPY = 150.0, 8
"The wire's flexural rigidity, and the segments at its tip over which it grows to that."
ROUTE, PIECE_MM, BEHIND_MM = "30:0,40:60,25:-40,40:0", 2.5, 30.0
MOST_MM, SHARPEST_MM = 190.0, 10.0
FASTEST_MM = 300.0 * STEP_S
FRAMES = 5


def route_of(text: str) -> np.ndarray:
    """Return the vessel's points, mm, and directions, rad, from 0 along x. Raises ValueError."""
    points = [(0.0, 0.0, 0.0)]
    for part in text.split(","):
        length_mm, turn = (float(number) for number in part.replace(":", " ").split())
        turn = math.radians(turn)
        if not (abs(turn) * SHARPEST_MM <= length_mm <= MOST_MM):
            raise ValueError(f"route {part!r}: allowed are lengths to {MOST_MM:g} mm, bent by {SHARPEST_MM:g} mm or more")
        pieces = max(round(length_mm / PIECE_MM), 1)
        step_mm = length_mm / pieces
        for _ in range(pieces):
            x, y, way = points[-1]
            way += turn / pieces
            points.append((x + step_mm * math.cos(way), y + step_mm * math.sin(way), way))
    if not BEHIND_MM < PIECE_MM * (len(points) - 1) <= MOST_MM:
        raise ValueError(f"route {text!r}: allowed are {BEHIND_MM:g} to {MOST_MM:g} mm in all")
    return np.array(points)


def sides_of(route: np.ndarray, offset_mm: float) -> list[np.ndarray]:
    """Return the points at both sides of the vessel and of the sheath in which the wire begins."""
    across = np.column_stack([-np.sin(route[:, 2]), np.cos(route[:, 2])])
    begins = np.array([-SEGMENT_MM * (SEGMENTS + 1), 0.0])
    return [np.vstack([begins + [0.0, each], route[:, :2] + each * across]) for each in (-offset_mm, offset_mm)]


def model_of(route: np.ndarray, friction: float, stiffness_N_mm: float) -> mujoco.MjModel:
    walls = wire = ""
    for side in sides_of(route, VESSEL_MM + THICK_MM):
        for (x, y), (to_x, to_y) in zip(side[:-1] / 1e3, side[1:] / 1e3, strict=True):
            walls += f'<geom class="wall" fromto="{x} {y} 0 {to_x} {to_y} 0" size="{THICK_MM / 1e3}"/>'
    for number in range(SEGMENTS):
        stiffness = 1e-3 * BENDING_N_MM2 / SEGMENT_MM * min(1.0, 0.2 + (SEGMENTS - 1 - number) / FLOPPY)
        at_mm = SEGMENT_MM if number else -SEGMENT_MM * SEGMENTS
        joint = f'<joint axis="0 0 1" stiffness="{stiffness}" damping="1e-3" armature="1e-6" range="-0.5 0.5"/>'
        wire += f'<body pos="{at_mm / 1e3} 0 0"><geom fromto="0 0 0 {SEGMENT_MM / 1e3} 0 0" size="{WIRE_MM / 1e3}"/>'
        wire += joint if number else '<joint name="base" type="slide" axis="1 0 0" damping="1"/>'
    x, y, way = route[-1 - round(BEHIND_MM / PIECE_MM)]
    return mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{STEP_S}" gravity="0 0 0" integrator="implicitfast"/>
  <default>
    <geom type="capsule" mass="2e-4" friction="{friction}" solref="0.008 1" contype="1" conaffinity="0"/>
    <default class="wall"><geom contype="0" conaffinity="1"/></default>
  </default>
  <worldbody>
    {walls}
    <body pos="{x / 1e3} {y / 1e3} 0" euler="0 0 {way}">
      <joint name="lesion" type="slide" axis="1 0 0" stiffness="{1e3 * stiffness_N_mm}" damping="2" armature="2e-3"/>
      <geom class="wall" type="box" size="1e-2 1e-2 1e-2" pos="1e-2 0 0" solref="0.004 1" priority="1"/>
    </body>
    {wire}{"</body>" * SEGMENTS}
  </worldbody>
  <actuator><position name="base" joint="base" kp="5000" dampratio="1"/></actuator>
</mujoco>""")


class Guidewire:
    def __init__(self, route: np.ndarray, friction: float, stiffness_N_mm: float) -> None:
        self._model = model_of(route, friction, stiffness_N_mm)
        self._data = mujoco.MjData(self._model)
        self._force_N = 0.0

    def push(self, place_mm: float) -> float:
        """Advance by STEP_S with the base at this place, and return the force that resists the way in."""
        self._data.ctrl[0] = place_mm / 1e3
        mujoco.mj_step(self._model, self._data)
        self._force_N += (float(self._data.actuator_force[0]) - self._force_N) * STEP_S / FILTER_S
        return self._force_N

    @property
    def shape_mm(self) -> np.ndarray:
        return 1e3 * self._data.xpos[2:, :2]


def run(
    client: Any,
    wire: Guidewire,
    seconds: float,
    clock_s: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> tuple[list[tuple[float, float, float, float, bool]], list[np.ndarray]]:
    """Return a row for each step, and the wire's shapes at FRAMES even times. A row is the time, the place, mm, the
    forces there and felt, N, and whether the wall was known.
    """
    estimator, rows, shapes_mm, handle_mm, place_mm, felt_N = ContactEstimator(), [], [], None, 0.0, math.nan
    began_s = due_s = clock_s()
    while due_s - began_s < seconds:
        handle_mm = next((motion.handle_mm for motion in client.motions()[-1:]), handle_mm)
        felt_N = next((state.measured_cf for state in client.telemetry()[-1:]), felt_N)
        if handle_mm is not None:
            way_mm = min(max((handle_mm - place_mm) * STEP_S / FILTER_S, -FASTEST_MM), FASTEST_MM)
            place_mm += way_mm
            force_N = SCALE * wire.push(place_mm)
            estimator.update(place_mm, force_N, way_mm)
            contact = estimator.contact
            client.publish(max(force_N, 0.0), withdraw_cf=max(-force_N, 0.0), contact=contact)
            rows.append((due_s - began_s, place_mm, force_N, felt_N, contact is not None))
        due_s += STEP_S
        if due_s - began_s >= seconds * (len(shapes_mm) + 1) / FRAMES:
            shapes_mm.append(wire.shape_mm.copy())
        wait(max(due_s - clock_s(), 0.0))
    return rows, shapes_mm


def draw(path: str, route: np.ndarray, rows: list[Any], shapes_mm: list[np.ndarray]) -> None:
    from matplotlib.figure import Figure

    figure = Figure((13.0, 6.0), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(2, 1))
    time_s, _, there_N, felt_N, is_known = np.array(rows, float).T
    axes = above.subplots()
    axes.plot(time_s, there_N, color="#222222", linewidth=0.9, label=f"at the wire's base, {SCALE:g} times as large")
    axes.plot(time_s, felt_N, color="#d1495b", label="felt at the handle, as measured")
    axes.fill_between(time_s, 0.0, is_known, color="#2a6f97", alpha=0.15, label="the lesion is known")
    axes.set(xlabel="time, s", ylabel="force, N", title="A guidewire pushed onto a lesion")
    above.legend(frameon=False, loc="outside lower center", ncols=3)
    for axes, shape_mm in zip(below.subplots(1, FRAMES, sharey=True), shapes_mm, strict=True):
        for side in sides_of(route, VESSEL_MM):
            axes.plot(*side.T, color="#8d99ae")
        axes.plot(*shape_mm.T, color="#d1495b", linewidth=1.5)
        axes.set(xlim=(-20.0, route[:, 0].max() + 5.0), aspect="equal", xlabel="mm")
    figure.savefig(path, dpi=110)


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--picture")
    parser.add_argument("--friction", type=float, default=0.2)
    parser.add_argument("--stiffness-N-mm", type=float, default=0.1)
    parser.add_argument("--route", default=ROUTE)
    return parser


def main() -> None:
    parser = arguments()
    options = parser.parse_args()
    for name, most in (("friction", 1.0), ("stiffness_N_mm", 10.0), ("seconds", 3600.0)):
        value = getattr(options, name)
        if not 0.0 < value <= most:
            parser.error(f"--{name.replace('_', '-')} {value}: allowed is above 0, to {most:g}")
    try:
        route = route_of(options.route)
    except ValueError as error:
        parser.error(str(error))
    wire = Guidewire(route, options.friction, options.stiffness_N_mm)
    began_s = time.monotonic()
    try:
        with Client.local(options.folder, wait_s=5.0, source="guidewire") as client:
            rows, shapes_mm = run(client, wire, options.seconds)
    except (ClientError, ValueError) as error:
        sys.exit(str(error))
    print(f"{options.seconds / (time.monotonic() - began_s):.2f} of real time, {len(rows)} setpoints")
    if not rows:
        sys.exit("the daemon told no motion of a handle: tormagctl status")
    if options.picture:
        draw(options.picture, route, rows, shapes_mm)


if __name__ == "__main__":
    main()
