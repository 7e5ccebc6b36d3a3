-- Uses a raster, which keeps it from expiring; stores it first if it is given. Returns it, or 1 if it is not wanted; nil if
-- it is not there.
-- KEYS: images, hash of the encoded rasters by digest; used, sorted set of the digests by the time of their last use;
--   bytes, size of all images
-- ARGV: digest, encoded raster or empty, budget in bytes, expiry in ms, 1 if the raster is wanted
local images, used, bytes = KEYS[1], KEYS[2], KEYS[3]
local digest, encoded, budget, expiry = ARGV[1], ARGV[2], tonumber(ARGV[3]), tonumber(ARGV[4])
local reserve = 0.1 -- share of Redis' memory that is left to the tracks: with less, rasters are given up

local function memory_is_short()
  local info = redis.pcall('INFO', 'memory')
  if type(info) ~= 'string' then
    return false -- the user may not ask
  end
  local limit = tonumber(string.match(info, '\nmaxmemory:(%d+)'))
  local taken = tonumber(string.match(info, '\nused_memory:(%d+)'))
  return limit > 0 and taken + #encoded > (1 - reserve) * limit
end

-- Redis evicts keys one by one, and the rest cannot be accounted for
local function is_incomplete()
  return redis.call('HLEN', images) ~= redis.call('ZCARD', used) or redis.call('EXISTS', bytes) == 0
end

if memory_is_short() then
  redis.call('UNLINK', images, used, bytes)
  return nil
end
if is_incomplete() then
  redis.call('UNLINK', images, used, bytes)
end
local time = redis.call('TIME')
local now = time[1] * 1000 + math.floor(time[2] / 1000)
if redis.call('HEXISTS', images, digest) == 0 then
  if encoded == '' or #encoded > budget then
    return nil
  end
  local total = tonumber(redis.call('GET', bytes) or 0) + #encoded
  while true do -- drop what has expired, then what was used least recently
    local oldest = redis.call('ZRANGE', used, 0, 0, 'WITHSCORES')
    if not oldest[1] or (tonumber(oldest[2]) >= now - expiry and total <= budget) then
      break
    end
    total = total - redis.call('HSTRLEN', images, oldest[1])
    redis.call('HDEL', images, oldest[1])
    redis.call('ZREM', used, oldest[1])
  end
  redis.call('HSET', images, digest, encoded)
  redis.call('SET', bytes, total)
end
redis.call('ZADD', used, now, digest)
for _, key in ipairs(KEYS) do
  redis.call('PEXPIRE', key, expiry)
end
if ARGV[5] == '1' then
  return redis.call('HGET', images, digest)
end
return 1
