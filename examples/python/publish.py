import csv, sys, time
from tormagd_client import Client, ClientError
if len(sys.argv) != 3:
    sys.exit("usage: python publish.py FOLDER PROFILE.csv")
folder, profile = sys.argv[1:]                # where the daemon's sockets are, and a CSV t_s,force_N
try:
    table = csv.DictReader(open(profile, encoding="utf-8-sig"))
    rows = [(float(row["t_s"]), float(row["force_N"])) for row in table]
    with Client.local(folder, wait_s=5.0) as client:
        client.arm()                          # home, which takes some seconds, then enable
        start_ns = time.time_ns()
        for t, force in rows:
            time.sleep(max(0.0, t - (time.time_ns() - start_ns) * 1e-9))
            client.publish(force, valid_for_ms=500.0, stamp_ns=start_ns + round(t * 1e9))
            for state in client.telemetry():
                print(f"{t:.3f} asked {force:.3f} measured {state.measured_cf:.3f} {state.operating_state}")
except (ClientError, OSError, KeyError, TypeError, ValueError) as error:
    sys.exit(str(error) if isinstance(error, ClientError | OSError) else f"{profile}, row {table.line_num}: {error!r}")
