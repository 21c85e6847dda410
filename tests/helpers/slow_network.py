"""A server's port -> another port of this machine that reaches it over a slow network which loses packets."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np

RESEND_S = (0.2, 0.6)  # after which TCP sends again what was lost; all that follows waits for it


@asynccontextmanager
async def slow_network(port: int, delay_s: float, loss: float, seed: int = 0) -> AsyncIterator[int]:
    """Forward connections with a delay each way, and yield the port to connect to.

    Args:
        port: Of the server.
        delay_s: One way [s].
        loss: Share of what is read at a time that is lost once and sent again.
        seed: Of what is lost.
    """
    rng, pumps = np.random.default_rng(seed), set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        queue: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        clock = asyncio.get_running_loop().time

        async def deliver() -> None:
            while True:
                due, content = await queue.get()
                await asyncio.sleep(max(0.0, due - clock()))
                if not content:
                    writer.close()
                    return
                writer.write(content)
                await writer.drain()

        delivering, due = asyncio.create_task(deliver()), 0.0
        try:
            while True:
                content = await reader.read(2048)
                lost = rng.uniform(*RESEND_S) if rng.random() < loss else 0.0
                due = max(due, clock() + delay_s + lost)
                queue.put_nowait((due, content))
                if not content:
                    await delivering
                    return
        except ConnectionError:
            pass
        finally:
            delivering.cancel()

    async def forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection("localhost", port)
        for ends in ((reader, far_writer), (far_reader, writer)):
            pumps.add(asyncio.create_task(pump(*ends)))

    server = await asyncio.start_server(forward, "localhost", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for task in pumps:
            task.cancel()
