"""Who of several keepers holds which shards of the work: a lease in Redis for each, taken and counted in one step."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

from service.queue.entries import text
from service.queue.port import Keeping, Share
from service.queue.streams import NUMBER, number_of

#: Names of those that hold shards or would, each with the number of shards that it was told, by when they fall silent.
KEEPERS: Final = "graspd:keepers"
#: Lease of the first shard. A graspd of one keeper knows this name and no other: so the two give way to each other.
_LEASE: Final = "graspd:lead:keeper"
#: Times that a list of keepers outlives the longest silence.
_KEPT: Final = 10

_TAKE: Final = f"""
local me, ms, n = ARGV[1], tonumber(ARGV[2]), tonumber(ARGV[3])
local time = redis.call('TIME')
local now = time[1] * 1000 + math.floor(time[2] / 1000)
-- Under these names anybody may have put anything.
local function get(key)
  local found = redis.pcall('GET', key)
  if type(found) == 'table' then redis.call('DEL', key) return false end
  return found
end
if not (redis.call('TYPE', KEYS[2])['ok'] == 'zset') then redis.call('DEL', KEYS[2]) end
redis.call('ZREMRANGEBYSCORE', KEYS[2], '-inf', now)
redis.call('ZADD', KEYS[2], now + ms, n .. ' ' .. me)
redis.call('PEXPIRE', KEYS[2], {_KEPT} * ms)
local agreed = tonumber(get(KEYS[3])) or 1
if agreed ~= n then
  -- Only who holds the first shard says into how many the work is cut.
  local first = get(KEYS[1])
  if first and first ~= me then return {{agreed, 0}} end
  redis.call('SET', KEYS[3], n)
end
local function lease(shard) return shard == 0 and KEYS[1] or KEYS[1] .. ':' .. shard end
local holds, mine, free = {{[me] = 0}}, {{}}, {{}}
for shard = 0, n - 1 do
  local holder = get(lease(shard))
  if holder == me then
    redis.call('SET', lease(shard), me, 'PX', ms)
    mine[#mine + 1] = shard
  end
  if holder then holds[holder] = (holds[holder] or 0) + 1 else free[shard] = true end
end
-- Where it does not come out even, those have one more who have it already.
local count, before = 0, 0
for _, one in ipairs(redis.call('ZRANGE', KEYS[2], 0, -1)) do
  local number, name = one:match('^(%d+) (.*)$')
  if tonumber(number) == n then
    count = count + 1
    local theirs = holds[name] or 0
    if name ~= me and (theirs > holds[me] or (theirs == holds[me] and name < me)) then before = before + 1 end
  end
end
local fair = math.floor(n / count) + (before < n % count and 1 or 0)
local function try(shard)
  if #mine < fair and free[shard] then
    redis.call('SET', lease(shard), me, 'PX', ms)
    free[shard] = nil
    mine[#mine + 1] = shard
  end
end
for place = 4, #ARGV do try(tonumber(ARGV[place])) end
for shard = 0, n - 1 do try(shard) end
return {{n, fair, unpack(mine)}}
"""
_GIVE_BACK: Final = """
for place = 2, #ARGV do
  local lease = ARGV[place] == '0' and KEYS[1] or KEYS[1] .. ':' .. ARGV[place]
  if redis.call('GET', lease) == ARGV[1] then redis.call('DEL', lease) end
end
"""


def lease_name(shard: int) -> str:
    """Key of a shard's lease."""
    return _LEASE if shard == 0 else f"{_LEASE}:{shard}"


def take_share(connection: Any, holder: str, seconds: float, number: int, before: Collection[int]) -> Share:
    """One step of Redis: keep what is held, and take what is free up to a fair share."""
    given = (holder, int(seconds * 1000), number, *sorted(before))
    agreed, fair, *held = connection.eval(_TAKE, 3, _LEASE, KEEPERS, NUMBER, *given)
    return Share(number=agreed, fair=fair, held=frozenset(held))


def give_back(connection: Any, holder: str, shards: Collection[int]) -> None:
    """Free leases that this holder has."""
    connection.eval(_GIVE_BACK, 1, _LEASE, holder, *shards)


def leave(connection: Any, holder: str, number: int) -> None:
    """Take a holder off the list of those who share the work."""
    connection.zrem(KEEPERS, f"{number} {holder}")


def read_keepers(connection: Any, part_keys: Any) -> list[Keeping]:
    """Who holds each shard, and whether it says that it works.

    Args:
        part_keys: from a shard to the key that its keeper keeps alive.
    """
    number = number_of(connection)
    with connection.pipeline(transaction=False) as pipe:
        for shard in range(number):
            pipe.get(lease_name(shard))
            pipe.exists(part_keys(shard))
        found = pipe.execute()
    return [Keeping(shard, text(found[2 * shard]), bool(found[2 * shard + 1])) for shard in range(number)]
