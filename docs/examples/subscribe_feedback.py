"""Listen to all modules with plain Zenoh and numpy: subscribe_feedback.py ENDPOINT [SECONDS]."""

import sys
import time

import zenoh

from module_agent import decode_feedback

endpoint, seconds = sys.argv[1], float(sys.argv[2]) if len(sys.argv) > 2 else 5.0


def show(sample: zenoh.Sample) -> None:
    """Print the newest row of a batch."""
    batch = decode_feedback(sample.payload)
    newest = batch.rows[-1]
    print(f"{batch.serial}: {newest['position_rad']:+.4f} rad, {newest['effort_nm']:+.3f} Nm", flush=True)


config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
with zenoh.open(config) as session, session.declare_subscriber("x5/*/*/feedback", show):
    time.sleep(seconds)
