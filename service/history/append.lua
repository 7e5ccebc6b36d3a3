-- Appends one call to a scene's log and answers what was appended since the caller looked last, in one step.
--
-- The log is a hash: f and l, the numbers of its first and last entry; <n>, entry n; k<n>, its key. Keys: the log; the
-- sign that somebody watches. Arguments: the number of the last entry that the caller knows (0: none) and its key;
-- the entry and its key (empty: append nothing); the number of the first entry that is still needed, for all that the
-- caller knows; ms that the log is kept; how many entries it has at most.
--
-- Answers: number of the last entry before this one; whether the caller knows the log (0: all of it is answered);
-- whether somebody watches; entries.
local known, key = tonumber(ARGV[1]), ARGV[2]
local entry, entry_key = ARGV[3], ARGV[4]
local needed, expiry, most = tonumber(ARGV[5]), ARGV[6], tonumber(ARGV[7])

local got = redis.pcall('HMGET', KEYS[1], 'f', 'l', 'k' .. known)
local first, last = tonumber(not got.err and got[1] or nil), tonumber(not got.err and got[2] or nil)
if not first or not last or first < 1 or last < first or last - first > 2 * most then  -- none, or none of ours
  -- Only if there is something: a script that has deleted is let past the limit of Redis' memory
  if got.err or redis.call('EXISTS', KEYS[1]) == 1 then redis.call('DEL', KEYS[1]) end
  first, last = 1, 0
end
local continues = known > 0 and known <= last and got[3] == key
local from = continues and math.max(known + 1, first) or first

local entries = {}
for number = from, last do
  entries[#entries + 1] = redis.call('HGET', KEYS[1], number) or ''
end

if entry ~= '' then
  local n = last + 1
  local keep = math.max(first, n - most + 1)
  if continues then keep = math.max(keep, math.min(needed, n)) end
  -- This first: where Redis is full it fails, and then nothing has changed
  redis.call('HSET', KEYS[1], 'f', keep, 'l', n, n, entry, 'k' .. n, entry_key)
  for number = first, keep - 1 do redis.call('HDEL', KEYS[1], number, 'k' .. number) end
  redis.call('PEXPIRE', KEYS[1], expiry)
end
return {last, continues and 1 or 0, redis.call('EXISTS', KEYS[2]), entries}
