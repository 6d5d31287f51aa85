"""A fixed piece of pure Python: how long it takes says what interpreter and processor are worth right now.

Two carriages under a PID, and the CRC of what they would send: the operations of a control tick, never compiled. Its
time stands beside every figure, to tell two machines, or two hours on a shared one, apart. A change would make every
earlier figure incomparable: a test holds its result.
"""

import statistics
import time

TICKS = 100
REPETITIONS = 25


class _Carriage:
    __slots__ = ("integral", "position_mm", "speed_mm_s")

    def __init__(self) -> None:
        self.position_mm = self.speed_mm_s = self.integral = 0.0

    def drive(self, duty: float) -> tuple[float, float]:
        self.speed_mm_s += (38.0 * duty - self.speed_mm_s) * 0.06
        self.position_mm += self.speed_mm_s * 0.001
        return self.position_mm, self.speed_mm_s


def work() -> tuple[float, float, int]:
    """Run one round, and return both carriages' last places, mm, and the CRC-16 of their way."""
    left, right, crc = _Carriage(), _Carriage(), 0xFFFF
    for tick in range(TICKS):
        wanted_mm = 0.01 * tick
        for carriage, gain in ((left, 3.6), (right, 3.1)):
            error_mm = wanted_mm - carriage.position_mm
            carriage.integral += 0.001 * error_mm
            duty = gain * error_mm + 10.0 * carriage.integral - 0.02 * carriage.speed_mm_s
            duty = min(max(duty, -1.0), 1.0)
            position_mm, _ = carriage.drive(duty)
            for byte in divmod(int(position_mm * 1000.0) & 0xFFFF, 256):
                crc ^= byte
                for _ in range(4):
                    crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
    return left.position_mm, right.position_mm, crc


def machine_us(repetitions: int = REPETITIONS) -> float:
    work()
    taken_ns = []
    for _ in range(repetitions):
        start_ns = time.thread_time_ns()
        work()
        taken_ns.append(time.thread_time_ns() - start_ns)
    return statistics.median(taken_ns) * 1e-3
