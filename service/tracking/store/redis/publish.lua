-- Publish events of a scene and return the number of events published so far.
--
-- Keys: the stream of the scene's events; the number of events so far. Arguments: expiry of both, ms; the minimum number
-- of entries that the stream keeps; the number of new events; the new events in one string.
local function publish()
  local last = redis.pcall('INCRBY', KEYS[2], ARGV[3])
  if type(last) == 'table' then return last end
  local added = redis.pcall('XADD', KEYS[1], 'MAXLEN', '~', ARGV[2], '*', 'last', last, 'events', ARGV[4])
  return type(added) == 'table' and added or last
end

local last = publish()
if type(last) == 'table' and not string.find(last.err, 'OOM') then  -- the keys hold something else
  redis.call('DEL', KEYS[1], KEYS[2])
  last = publish()
end
if type(last) == 'table' then return last end
redis.call('PEXPIRE', KEYS[1], ARGV[1])
redis.call('PEXPIRE', KEYS[2], ARGV[1])
return last
