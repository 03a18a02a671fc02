"""Many streams over WebSocket in one process: microphone and reference in, the human and events out (docs/serve.md).

Needs `pip install '.[serve]'` in a checkout, and '.[serve,opus]' for Opus.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import json
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from typing import Any, cast

import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import Opcode
from websockets.http11 import Request, Response

from edgefilter.audio.raw import delivered, of_pcm16
from edgefilter.dsp.resample import Resampler
from edgefilter.errors import EdgefilterError, SignalError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.doors import complain_briefly, in_one_line
from edgefilter.integrations.duplex import Pace, as_pcm16, from_pcm16
from edgefilter.integrations.wire import Decode, Form, Limits, TwoStreams, message_of
from edgefilter.types import SAMPLE_RATE, SET_UP_WRONG, Event, Samples

_LOGGER = logging.getLogger(__name__)
Answer = bytes | str


class Session:
    """One client's stream: its messages in, what is to be sent to it out; no network.

    form: its first message. ego: its own. ended: whether its last answer was given. can_wait: whether what is left of the work
    of the latest message is ahead of its time, or was when it came.
    """

    def __init__(self, form: Form, ego: EgoFilter, limits: Limits) -> None:
        self.form, self.ego, self._limits = form, ego, limits
        ego.queued_s = form.queued_ms / 1000
        rate, self._now = form.rate, asyncio.get_running_loop().time
        self._to_filter = Resampler(rate, SAMPLE_RATE, form.microphones), Resampler(rate, SAMPLE_RATE)
        self._pace = Pace(self._now)
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
        late, self._part = round(form.late_ms * rate / 1000), round(limits.part_s * rate)
        self._two = TwoStreams(*decoders, rate, late, limits) if form.streams == "two" else None
        self.delay_ms = 1000 * (ego.latency / SAMPLE_RATE + self._to_filter[0].delay_s + codec_s)
        self._announced = self.can_wait = self.ended = False
        self._due, self._sound_s = self._now(), 0.0
        self._counted = self._counts()

    def ready(self, learns: bool) -> str:
        """The first answer."""
        told = {"rate": self.form.rate, "codec": self.form.codec, "engine": self.ego.engine_name}
        return _text("ready", **told, delay_ms=round(self.delay_ms, 1), late_ms=self.form.late_ms, learn=learns)

    def charge(self, spent_s: float) -> None:
        """Count the time of the processor that a part has taken; more work, or sound, than is due can wait from then on."""
        now = self._now()
        self._due = max(self._due, now - self._limits.behind_s) + max(self._sound_s, spent_s / self._limits.share)
        self._sound_s = 0.0
        self.can_wait |= self._due > now + self._limits.ahead_s

    def take(self, message: bytes | str) -> Iterator[list[Answer]]:
        """Take a message; what is to be answered, part by part. Raises SignalError for one that is none."""
        self.can_wait = self._due > self._now() + self._limits.ahead_s
        if isinstance(message, str):
            kind = message_of(message, self._limits.text).get("kind")
            if kind == "end":
                yield from self.finish()
            elif kind != "announce":
                raise SignalError(f"found a message of kind {kind!r}, expected 'announce' or 'end'")
            self._announced = kind == "announce"
        elif self._announced:
            self._announced, self.can_wait = False, True
            yield from self._announce(message)
        else:
            if self._two:
                self._two.push(message)
                yield from self._filter(*self._two.take())
            else:
                yield from self._stereo(message)

    def finish(self) -> Iterator[list[Answer]]:
        """The filter's last samples and the closing message with the statistics; nothing once they have been returned."""
        if self.ended:
            return
        nothing = _microphones_of(b"", self.form.microphones), np.zeros(0, np.float32)
        if self._two:
            yield from self._filter(*self._two.take(last=True))
        yield self._filter_part(*nothing, last=True)
        stats = self.ego.stats()
        figures = {name: stats[name] for name in ("samples", "engine", "array")}
        self.ended = True
        yield [_text("ended", **figures, **self._counts(), deadline=stats["deadline"])]

    def _announce(self, utterance: bytes) -> Iterator[list[Answer]]:
        whole, samples, parts = Resampler(self.form.rate, SAMPLE_RATE), from_pcm16(utterance), []
        for at in range(0, samples.size, self.form.rate // 4):
            yield []
            parts.append(whole.push(samples[at : at + self.form.rate // 4]))
        parts.append(whole.push(np.zeros(0, np.float32), last=True))
        self.ego.announce(np.concatenate(parts))

    def _stereo(self, message: bytes) -> Iterator[list[Answer]]:
        channels = self.form.microphones + 1
        both = of_pcm16(message, channels)
        if wrong := self._pace.note(len(both), self.form.rate):
            yield [self._told(Event("rate_mismatch", self.ego.stats()["samples"], wrong))]
        yield from self._filter(
            np.ascontiguousarray(delivered(both, range(channels - 1))), np.ascontiguousarray(both[:, -1])
        )

    def _filter(self, mic: Samples, ref: Samples) -> Iterator[list[Answer]]:
        for at in range(0, len(mic), self._part):
            part = slice(at, min(at + self._part, len(mic)))
            self._sound_s = (part.stop - at) / self.form.rate
            yield self._filter_part(mic[part], ref[part], last=False)

    def _filter_part(self, mic: Samples, ref: Samples, last: bool) -> list[Answer]:
        heard, played = (each.push(x, last) for each, x in zip(self._to_filter, (mic, ref)))
        human = self.ego.process(heard, played)
        events = self.ego.events()
        if last:
            human = np.concatenate((human, self.ego.flush()))
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

    make_filter: makes a stream's filter; told whether it learns, and the first message. streams: clients at a time; more are sent
    away with a word. learners: streams that may learn at a time. token: what a client has to send as `Authorization: Bearer TOKEN`.
    Programs within web pages are sent away: a page that somebody opens must not listen to the robot.
    """

    def __init__(
        self,
        make_filter: Callable[[bool, Form], EgoFilter],
        streams: int,
        learners: int,
        token: str | None,
        limits: Limits = Limits(),
    ) -> None:
        self._limits = limits
        self._make, self._streams, self._learners, self._token = make_filter, streams, learners, token
        self._serving = self._learning = 0
        self._making, self._backlog, self._done = asyncio.Lock(), asyncio.Lock(), 0
        self._guests: dict[ServerConnection, None] = {}
        self._conversing: set[asyncio.Task[None]] = set()
        self._stopping = asyncio.Event()

    async def run(self, host: str, port: int, ready: Callable[[int], None] = lambda port: None) -> None:
        """Serve until `stop`; ready: called with the port once clients may come. Raises OSError where that cannot be had."""
        complain_briefly()
        log = _LOGGER.getChild("websockets")
        log.addFilter(in_one_line)
        # a client that sends faster than its messages are filtered is read no faster: two wait here, the others with it
        limits = self._limits
        waits: dict[str, Any] = {
            "open_timeout": limits.patience_s,
            "close_timeout": limits.patience_s,
            "ping_interval": None,
        }
        connection = partial(_Connection, self._guests, limits)
        listen = partial(serve, max_size=limits.message, max_queue=1, backlog=limits.guests, **waits)
        listen = partial(listen, compression=None, origins=[None], logger=log, create_connection=connection)
        async with listen(self._greet, host, port, process_request=self._admit) as server:
            ready(int(next(iter(server.sockets)).getsockname()[1]))
            await self._stopping.wait()
            if ending := [*self._conversing]:
                for each in ending:
                    each.cancel()
                await asyncio.wait(ending, timeout=limits.patience_s)

    def stop(self) -> None:
        """Let all streams end in good order; then `run` returns."""
        self._stopping.set()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get_all("Authorization")
        if len(given) > 1:
            who = connection.remote_address
            _LOGGER.warning("client %s: found %d Authorization headers, expected one; it is refused", who, len(given))
            return connection.respond(http.HTTPStatus.BAD_REQUEST, "one Authorization header is expected\n")
        said = "".join(given).encode()
        if self._token is not None and not hmac.compare_digest(said, f"Bearer {self._token}".encode()):
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "a token is needed: Authorization: Bearer TOKEN\n")
        return None

    async def _greet(self, connection: ServerConnection) -> None:
        if self._serving >= self._streams:
            await connection.close(1013, f"{self._streams} streams are served already: come back later")
            return
        self._serving += 1
        self._guests.pop(connection, None)
        why = ""
        try:
            await self._serve(connection)
        except EdgefilterError as error:
            why = str(error)
        except (ConnectionClosed, ConnectionError):
            pass  # it has gone
        finally:
            self._serving -= 1
            self._guests[connection] = None
        if why:  # what it held is free by now
            await self._send_away(connection, why)

    async def _send_away(self, connection: ServerConnection, why: str) -> None:
        _LOGGER.warning("client %s: %s; its connection is closed", connection.remote_address, why)
        try:
            await asyncio.wait_for(connection.send(_text("error", detail=why)), self._limits.patience_s)
            _refuse(connection, why)
            await asyncio.wait_for(connection.wait_closed(), self._limits.patience_s)
        except (ConnectionClosed, TimeoutError, asyncio.TimeoutError):
            connection.transport.abort()

    async def _serve(self, connection: ServerConnection) -> None:
        form = Form.of(await _message(connection, self._limits.patience_s, self._limits.frames))
        learns = form.learn and self._learning < self._learners
        self._learning += learns
        ego = None
        try:
            async with (
                self._making
            ):  # one at a time: several would hold the interpreter's lock and delay the others' sound
                ego = await asyncio.to_thread(self._make, learns, form)
            session = Session(form, ego, self._limits)
            await self._send(connection, deque([session.ready(learns)]))
            await self._converse(connection, session)
        except ModuleNotFoundError as error:
            raise SignalError(f"codec {form.codec} needs {error.name} at the server: pip install '.[opus]'") from None
        finally:
            self._learning -= learns
            if ego is not None:
                await asyncio.to_thread(ego.close)

    async def _converse(self, connection: ServerConnection, session: Session) -> None:
        """Filter part by part, in the event loop: threads would only wait for one another's interpreter lock."""
        answers: deque[Answer] = deque()
        work: Iterator[list[Answer]] = iter(())
        task = asyncio.current_task()
        assert task is not None
        self._conversing.add(task)
        try:
            if self._stopping.is_set():
                raise asyncio.CancelledError
            while not session.ended:
                work = session.take(await _message(connection, self._limits.idle_s, self._limits.frames))
                await self._work(connection, session, work, answers)
        except asyncio.CancelledError:
            if not self._stopping.is_set():
                raise
            await self._work(connection, session, chain(work, session.finish()), answers)
        finally:
            self._conversing.discard(task)
        await connection.close(1001 if self._stopping.is_set() else 1000)

    async def _work(
        self, connection: ServerConnection, session: Session, work: Iterator[list[Answer]], answers: deque[Answer]
    ) -> None:
        """Do a client's work part by part, and others' in between."""
        await self._send(connection, answers)
        more: list[Answer] | None = []
        while more is not None:
            await self._turn(session)
            began = time.thread_time()
            more = next(work, None)
            session.charge(time.thread_time() - began)
            answers.extend(more or ())
            await self._send(connection, answers)

    async def _turn(self, session: Session) -> None:
        """Yield to the event loop; a session that can wait queues with other such sessions until all urgent ones are idle."""
        await asyncio.sleep(0)
        if session.can_wait:
            async with self._backlog:
                quiet = 0
                while quiet < self._limits.turns:
                    done = self._done
                    await asyncio.sleep(0)
                    quiet = quiet + 1 if done == self._done else 0
        self._done += 1

    async def _send(self, connection: ServerConnection, answers: deque[Answer]) -> None:
        """Send them in their order; a client that does not read them in time is let go."""
        slow = asyncio.get_running_loop().call_later(self._limits.patience_s, _let_go, connection)
        try:
            while answers:
                await connection.send(answers[0])
                answers.popleft()
        finally:
            slow.cancel()


class _Connection(ServerConnection):
    """A client's connection, of which a little is read at a time. guests: those without a stream, oldest first."""

    def __init__(self, guests: dict[ServerConnection, None], limits: Limits, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._guests, self._limits, self._pings = guests, limits, 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # of asyncio's transports on sockets: 256 kB of frames without content take 0.3 s
        cast(Any, transport).max_size = self._limits.read_at_once
        super().connection_made(transport)
        self._guests[self] = None
        if len(self._guests) > self._limits.guests:
            next(iter(self._guests)).transport.abort()

    def process_event(self, event: Any) -> None:
        super().process_event(event)
        self._pings = self._pings + 1 if getattr(event, "opcode", 0) >= Opcode.CLOSE else 0
        if self._pings == self._limits.pings:
            _refuse(self, f"{self._pings} pings without a message: send sound")

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.transport.get_write_buffer_size() > self._limits.unread:
            _let_go(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._guests.pop(self, None)
        super().connection_lost(exc)


async def _message(connection: ServerConnection, patience_s: float, frames: int) -> bytes | str:
    """The next message; raises SignalError for one in too many frames, and where none comes for so long."""

    async def whole() -> bytes | str:
        parts: list[Any] = []
        async for part in connection.recv_streaming():
            parts.append(part)
            if len(parts) > frames:
                raise SignalError(f"a message in more than {frames} frames, expected fewer: send it in one")
        return type(parts[0])().join(parts)

    try:
        return await asyncio.wait_for(whole(), patience_s)
    except (TimeoutError, asyncio.TimeoutError):
        raise SignalError(f"no message came for {patience_s:.0f} s: send sound, or end the session") from None


def _refuse(connection: ServerConnection, why: str) -> None:
    """Close with a reason; what still comes is read and dropped, so that the reason is not lost."""
    # RFC 6455, 5.5: 125 bytes with the code
    connection.protocol.fail(1008, why.encode()[:120].decode(errors="ignore"))
    connection.send_data()
    connection.transport.resume_reading()


def _let_go(connection: ServerConnection) -> None:
    _LOGGER.warning("client %s reads too slowly; its connection is closed", connection.remote_address)
    connection.transport.abort()


def _microphones_of(pcm: bytes, count: int) -> Samples:
    """Samples of one microphone, (n,), or of several, (n, count)."""
    return np.ascontiguousarray(delivered(of_pcm16(pcm, count), range(count)))


def _text(kind: str, **more: object) -> str:
    return json.dumps({"kind": kind, **more}, allow_nan=False, default=float)
