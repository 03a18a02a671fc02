"""Many streams over WebSocket in one process: microphone and reference in, the human and events out (docs/serve.md).

Needs `pip install '.[serve]'` in a checkout, and '.[serve,opus]' for Opus.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import json
import logging
from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from edgefilter.audio.raw import of_pcm16
from edgefilter.dsp.resample import Resampler
from edgefilter.errors import EdgefilterError, SignalError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.channels import taken
from edgefilter.integrations.duplex import Pace, as_pcm16, from_pcm16
from edgefilter.integrations.wire import Decode, Form, TwoStreams, message_of
from edgefilter.types import SAMPLE_RATE, SET_UP_WRONG, Event, Samples

MOST_BYTES = 4_000_000
"""Size of a message: an announced utterance of 40 s at 48 kHz; of sound some 20 ms are usual."""
PATIENCE_S = 5.0
"""For how long a client may take for its first message, and for reading an answer."""
_LOGGER = logging.getLogger(__name__)
Answer = bytes | str


class Session:
    """One client's stream: its messages in, what is to be sent to it out; no network. form: its first message. ego: its own."""

    def __init__(self, form: Form, ego: EgoFilter) -> None:
        self.form, self.ego = form, ego
        rate = form.rate
        self._to_filter = Resampler(rate, SAMPLE_RATE, form.microphones), Resampler(rate, SAMPLE_RATE)
        self._pace = Pace(asyncio.get_running_loop().time) if form.streams == "stereo" else None
        self._encode: Callable[[Samples, bool], list[bytes]]
        decoders: tuple[Decode, Decode] = partial(_microphones_of, count=form.microphones), from_pcm16
        if form.codec == "opus":
            from edgefilter.integrations.opus import FRAME_MS, Decoder, Encoder

            decoders = Decoder().decode, Decoder().decode
            self._encode = Encoder(form.bitrate).push
            codec_s = FRAME_MS / 1000
        else:
            from_filter = Resampler(SAMPLE_RATE, rate)
            self._encode = lambda human, last: [as_pcm16(from_filter.push(human, last))]
            codec_s = from_filter.delay_s
        late = round(form.late_ms * rate / 1000)
        self._two = TwoStreams(*decoders, rate, late) if form.streams == "two" else None
        self.delay_ms = 1000 * (ego.latency / SAMPLE_RATE + self._to_filter[0].delay_s + codec_s)
        self._announced = False
        self._counted = self._counts()

    def ready(self, learns: bool) -> str:
        """The first answer."""
        told = {"rate": self.form.rate, "codec": self.form.codec, "engine": self.ego.engine_name}
        return _text("ready", **told, delay_ms=round(self.delay_ms, 1), late_ms=self.form.late_ms, learn=learns)

    def take(self, message: bytes | str) -> tuple[list[Answer], bool]:
        """Take a message; what is to be answered, and whether it was the last one. Raises SignalError for one that is none."""
        if isinstance(message, str):
            kind = message_of(message).get("kind")
            if kind == "end":
                return self.finish(), True
            if kind != "announce":
                raise SignalError(f"found a message of kind {kind!r}, expected 'announce' or 'end'")
            self._announced = True
            return [], False
        if self._announced:
            self._announced = False
            whole = Resampler(self.form.rate, SAMPLE_RATE)
            self.ego.announce(whole.push(from_pcm16(message), last=True))
            return [], False
        if self._two:
            self._two.push(message)
            mic, ref = self._two.take()
        else:
            both = of_pcm16(message, self.form.microphones + 1)
            mic, ref = taken(both, range(self.form.microphones)), np.ascontiguousarray(both[:, -1])
        return self._filter(mic, ref, last=False), False

    def finish(self) -> list[Answer]:
        """The rest, and the last answer, with the figures."""
        nothing = _microphones_of(b"", self.form.microphones), np.zeros(0, np.float32)
        answers = self._filter(*(self._two.take(last=True) if self._two else nothing), last=True)
        stats = self.ego.stats()
        figures = {name: stats[name] for name in ("samples", "engine", "array")}
        return [*answers, _text("ended", **figures, **self._counts(), deadline=stats["deadline"])]

    def _filter(self, mic: Samples, ref: Samples, last: bool) -> list[Answer]:
        heard, played = (each.push(x, last) for each, x in zip(self._to_filter, (mic, ref)))
        human = self.ego.process(heard, played)
        events = self.ego.events()
        if last:
            human = np.concatenate((human, self.ego.flush()))
        if self._pace and (wrong := self._pace.note(len(mic), self.form.rate)):
            events.append(Event("rate_mismatch", self.ego.stats()["samples"], wrong))
        answers: list[Answer] = [part for part in self._encode(human, last) if part]
        return answers + [self._told(event) for event in [*events, *self._troubles()]]

    def _counts(self) -> dict[str, int]:
        return {"lost": self._two.lost, "late": self._two.late} if self._two else {"lost": 0, "late": 0}

    def _troubles(self) -> list[Event]:
        """What has been lost or came too late since the last look, as events."""
        before, self._counted = self._counted, self._counts()
        sample, found = self.ego.stats()["samples"], []
        if (lost := self._counted["lost"] - before["lost"]) > 0:
            found.append(Event("lost", sample, f"{lost} samples never came: silence stands in"))
        if self._two and self._counted["late"] > before["late"] == 0:
            later = 1000 * self._two.lateness / self.form.rate
            said = f"the reference comes {later:.0f} ms later than the {self.form.late_ms} ms for which the microphone waits"
            found.append(Event("reference_late", sample, f"{said}: say more in late_ms"))
        return found

    def _told(self, event: Event) -> str:
        if event.kind in SET_UP_WRONG:
            _LOGGER.warning("%s: %s", event.kind.replace("_", " "), event.detail)
        return _text(event.kind, time=round(event.sample / SAMPLE_RATE, 3), detail=event.detail)


class Service:
    """Serves streams until it is told to stop.

    make_filter: makes a stream's filter; told whether it learns. streams: clients at a time; more are sent away with a
    word. learners: streams that may learn at a time. token: what a client has to send as `Authorization: Bearer TOKEN`.
    Programs within web pages are sent away: a page that somebody opens must not listen to the robot.
    """

    def __init__(
        self, make_filter: Callable[[bool], EgoFilter], streams: int, learners: int, token: str | None
    ) -> None:
        self._make, self._streams, self._learners, self._token = make_filter, streams, learners, token
        self._serving = self._learning = 0
        self._conversing: set[asyncio.Task[None]] = set()
        self._stopping = asyncio.Event()

    async def run(self, host: str, port: int, ready: Callable[[int], None] = lambda port: None) -> None:
        """Serve until `stop`; ready: called with the port once clients may come. Raises OSError where that cannot be had."""
        # a client that sends faster than max_queue messages are filtered is read no faster
        limits = partial(serve, max_size=MOST_BYTES, max_queue=16, compression=None, origins=[None])
        async with limits(self._greet, host, port, process_request=self._admit) as server:
            ready(int(next(iter(server.sockets)).getsockname()[1]))
            await self._stopping.wait()
            if ending := [*self._conversing]:
                for each in ending:
                    each.cancel()
                await asyncio.wait(ending, timeout=PATIENCE_S)

    def stop(self) -> None:
        """Let all streams end in good order; then `run` returns."""
        self._stopping.set()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get("Authorization", "")
        if self._token is not None and not hmac.compare_digest(given.encode(), f"Bearer {self._token}".encode()):
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "a token is needed: Authorization: Bearer TOKEN\n")
        return None

    async def _greet(self, connection: ServerConnection) -> None:
        if self._serving >= self._streams:
            await connection.close(1013, f"{self._streams} streams are served already: come back later")
            return
        self._serving += 1
        try:
            await self._serve(connection)
        except (EdgefilterError, TimeoutError) as error:
            await self._send_away(connection, str(error) or f"nothing was heard for {PATIENCE_S:.0f} s")
        except (ConnectionClosed, ConnectionError):
            pass  # it has gone
        finally:
            self._serving -= 1

    async def _send_away(self, connection: ServerConnection, why: str) -> None:
        _LOGGER.warning("client %s: %s; its connection is closed", connection.remote_address, why)
        try:
            await asyncio.wait_for(connection.send(_text("error", detail=why)), PATIENCE_S)
            # RFC 6455, 5.5: 125 bytes with the code
            await connection.close(1008, why.encode()[:120].decode(errors="ignore"))
        except (ConnectionClosed, TimeoutError):
            connection.transport.abort()

    async def _serve(self, connection: ServerConnection) -> None:
        form = Form.of(await asyncio.wait_for(connection.recv(), PATIENCE_S))
        learns = form.learn and self._learning < self._learners
        self._learning += learns
        ego = None
        try:
            ego = await asyncio.to_thread(self._make, learns)
            session = Session(form, ego)
            await self._send(connection, deque([session.ready(learns)]))
            await self._converse(connection, session)
        except ModuleNotFoundError as error:
            raise SignalError(f"codec {form.codec} needs {error.name} at the server: pip install '.[opus]'") from None
        finally:
            self._learning -= learns
            if ego is not None:
                await asyncio.to_thread(ego.close)

    async def _converse(self, connection: ServerConnection, session: Session) -> None:
        """Filter message by message, in the event loop: threads would only wait for one another's interpreter lock."""
        answers: deque[Answer] = deque()
        task = asyncio.current_task()
        assert task is not None
        self._conversing.add(task)
        try:
            if self._stopping.is_set():
                raise asyncio.CancelledError
            ended = False
            while not ended:
                more, ended = session.take(await connection.recv())
                answers.extend(more)
                await self._send(connection, answers)
        except asyncio.CancelledError:
            if not self._stopping.is_set():
                raise
            answers.extend(session.finish())
            await self._send(connection, answers)
        finally:
            self._conversing.discard(task)
        await connection.close(1001 if self._stopping.is_set() else 1000)

    async def _send(self, connection: ServerConnection, answers: deque[Answer]) -> None:
        """Send them in their order; a client that does not read them in time is let go."""
        slow = asyncio.get_running_loop().call_later(PATIENCE_S, self._let_go, connection)
        try:
            while answers:
                await connection.send(answers[0])
                answers.popleft()
        finally:
            slow.cancel()

    def _let_go(self, connection: ServerConnection) -> None:
        _LOGGER.warning("client %s reads too slowly; its connection is closed", connection.remote_address)
        connection.transport.abort()


def _microphones_of(pcm: bytes, count: int) -> Samples:
    """Samples of one microphone, (n,), or of several, (n, count)."""
    return taken(of_pcm16(pcm, count), range(count))


def _text(kind: str, **more: object) -> str:
    return json.dumps({"kind": kind, **more}, allow_nan=False, default=float)
