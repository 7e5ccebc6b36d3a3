-- Keys: the stream of a scene's events, and how many there were. Arguments: ms that both are kept, how many entries
-- the stream keeps at least, how many events come, and these in one string.
local last = redis.call('INCRBY', KEYS[2], ARGV[3])
redis.call('XADD', KEYS[1], 'MAXLEN', '~', ARGV[2], '*', 'last', last, 'events', ARGV[4])
redis.call('PEXPIRE', KEYS[1], ARGV[1])
redis.call('PEXPIRE', KEYS[2], ARGV[1])
return last
