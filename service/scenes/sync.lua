-- Tell which scenes this server was called for and which it watches; return which are watched, as "server scene".
--
-- KEYS: summaries, hash by "server scene"; updated, sorted set of its fields by the time of their last change, ms;
--   watched, sorted set of "server scene" by the time at which the watch expires, ms
-- ARGV: expiry of scenes, ms; expiry of watches, ms; max number of summaries; number of scenes that this server watches;
--   those; then fields and summaries in turn
local summaries, updated, watched = KEYS[1], KEYS[2], KEYS[3]
local expiry, watch_expiry, most, watching = tonumber(ARGV[1]), tonumber(ARGV[2]), tonumber(ARGV[3]), tonumber(ARGV[4])
local time = redis.call('TIME')
local now = time[1] * 1000 + math.floor(time[2] / 1000)

local function drop(fields)
  for _, field in ipairs(fields) do
    redis.call('HDEL', summaries, field)
    redis.call('ZREM', updated, field)
  end
end

drop(redis.call('ZRANGEBYSCORE', updated, '-inf', now - expiry))
redis.call('ZREMRANGEBYSCORE', watched, '-inf', now)
for i = 5, 4 + watching do
  redis.call('ZADD', watched, now + watch_expiry, ARGV[i])
end
for i = 5 + watching, #ARGV, 2 do
  redis.call('HSET', summaries, ARGV[i], ARGV[i + 1])
  redis.call('ZADD', updated, now, ARGV[i])
end
local excess = redis.call('ZCARD', updated) - most
if excess > 0 then drop(redis.call('ZRANGE', updated, 0, excess - 1)) end
redis.call('PEXPIRE', summaries, expiry)
redis.call('PEXPIRE', updated, expiry)
redis.call('PEXPIRE', watched, watch_expiry)
return redis.call('ZRANGE', watched, 0, -1)
