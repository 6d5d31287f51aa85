"""Rings the terminal's bell for an operator who does not look at a screen.

It rings once for a new limit, and every two seconds while the device is in FAULT or silent.

    python cue.py FOLDER [LIMIT ...]     the folder of the daemon's sockets, and the limits that are to be heard
"""

import sys, time
from tormagd_client import Client, ClientError

LIMITS = ("STALE", "OTHER_SOURCE", "RANGE", "F_MAX", "CEILING", "SENSOR", "DEVICE_OR_SENSOR")
AGAIN_S, SILENT_S, LOOK_S = 2.0, 0.5, 0.05


class Cue:
    def __init__(self, limits, now_s):
        self.held_s = dict.fromkeys(limits, now_s - AGAIN_S)
        self.heard_s, self.rung_s, self.faults = now_s, now_s - AGAIN_S, ()

    def due(self, states, now_s):
        came = []
        for state in states:
            for limit in self.held_s.keys() & set(state.limits):  # a limit that comes and goes is rung for once
                came += [limit] if now_s - self.held_s[limit] >= AGAIN_S else []
                self.held_s[limit] = now_s
            self.heard_s, self.faults = now_s, state.faults
        lasting = ["nothing is heard"] if now_s - self.heard_s > SILENT_S else list(self.faults)
        if lasting and now_s - self.rung_s < AGAIN_S:
            return came
        if lasting:
            self.rung_s = now_s
        return lasting + came


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python cue.py FOLDER [LIMIT ...]")
    try:
        with Client.local(sys.argv[1]) as client:
            cue = Cue(sys.argv[2:] or LIMITS, time.monotonic())
            while True:
                for what in cue.due(client.telemetry(), time.monotonic()):
                    print(f"\a{time.strftime('%H:%M:%S')} {what}", flush=True)
                time.sleep(LOOK_S)
    except (ClientError, KeyboardInterrupt) as error:
        sys.exit(str(error))
