-- Append one call to a scene's log and return what was appended since the caller's last read, in one step.
--
-- The log is a hash: i, its name; f and l, the numbers of its first and last entry; <n>, entry n; k<n>, its key.
-- Keys: the log; the flag that the scene has a watcher. Arguments: the name of the log that the caller knows; the number
-- of the last entry that it knows (0: none) and that entry's key; the entry and its key (empty: append nothing); the
-- number of the first entry that the caller still needs; expiry of the log, ms; the maximum number of entries.
--
-- Returns: the log's name; the number of the last entry before this one; whether the entries continue what the caller
-- knows (0: they are the whole log); whether this is the log that the caller knows; whether the scene has a watcher; the
-- entries.
local name, known, key = ARGV[1], tonumber(ARGV[2]), ARGV[3]
local entry, entry_key = ARGV[4], ARGV[5]
local needed, expiry, most = tonumber(ARGV[6]), ARGV[7], tonumber(ARGV[8])

local got = redis.pcall('HMGET', KEYS[1], 'i', 'f', 'l', 'k' .. known)
local own = not got.err and got[1]
local first, last = tonumber(own and got[2] or nil), tonumber(own and got[3] or nil)
if not first or not last or first < 1 or last < first or last - first > 2 * most then  -- no log, or not one of ours
  -- Only if the key exists: after a deletion, a script may exceed Redis' memory limit
  if got.err or redis.call('EXISTS', KEYS[1]) == 1 then redis.call('DEL', KEYS[1]) end
  own, first, last = entry_key, 1, 0
end
-- The entry that the caller knows may have been dropped since. If another entry has its number, the log lost its end
local same = own == name and known <= last and (known < first or got[4] == key)
local continues = same and known >= first
local from = continues and known + 1 or first

local entries = {}
for number = from, last do
  entries[#entries + 1] = redis.call('HGET', KEYS[1], number) or ''
end

if entry ~= '' then
  local n = last + 1
  local keep = math.max(first, n - most + 1)
  if continues then keep = math.max(keep, math.min(needed, n)) end
  -- First: this fails if Redis is full, and then nothing has changed
  redis.call('HSET', KEYS[1], 'i', own, 'f', keep, 'l', n, n, entry, 'k' .. n, entry_key)
  for number = first, keep - 1 do redis.call('HDEL', KEYS[1], number, 'k' .. number) end
  redis.call('PEXPIRE', KEYS[1], expiry)
end
return {own, last, continues and 1 or 0, same and 1 or 0, redis.call('EXISTS', KEYS[2]), entries}
