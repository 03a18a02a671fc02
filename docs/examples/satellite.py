"""A device with two channels, microphone and reference, whose sound `edgefilter serve` filters.

arecord -q -c 2 -r 16000 -f S16_LE -t raw | python satellite.py ws://127.0.0.1:10620 > human.raw

Needs `pip install websockets`. With a token: connect(address, additional_headers={"Authorization": "Bearer TOKEN"}).
"""

import json
import sys
import threading

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

FRAME = 4 * 320  # 20 ms of 16-bit samples of both channels at 16 kHz


def send(server):
    while stereo := sys.stdin.buffer.read(FRAME):
        server.send(stereo)
    server.send(json.dumps({"kind": "end"}))


if len(sys.argv) != 2:
    sys.exit("satellite.py: expected the address of the service, such as ws://127.0.0.1:10620")
try:
    with connect(sys.argv[1], compression=None) as server:
        server.send(json.dumps({"rate": 16000}))
        threading.Thread(target=send, args=(server,), daemon=True).start()
        for answer in server:
            if isinstance(answer, bytes):
                sys.stdout.buffer.write(answer)  # the human, 16 bit
            else:
                print(answer, file=sys.stderr)  # what happened, in JSON
except (OSError, WebSocketException) as error:  # nobody serves there, the token is not the right one, or it has ended
    sys.exit(f"satellite.py: {sys.argv[1]}: {error}; does 'edgefilter serve' run there?")
