-- Append a frame to the stream of a scene, and store its map if it is given; return whether the map is there.
--
-- KEYS: frames, the stream; map, the map of the frame
-- ARGV: max number of frames; expiry of both, ms; server; frame; map or empty
local frames, map = KEYS[1], KEYS[2]
redis.call('XADD', frames, 'MAXLEN', '=', ARGV[1], '*', 'server', ARGV[3], 'frame', ARGV[4])
redis.call('PEXPIRE', frames, ARGV[2])
if ARGV[5] ~= '' then
  redis.call('SET', map, ARGV[5], 'PX', ARGV[2])
  return 1
end
return redis.call('PEXPIRE', map, ARGV[2])
