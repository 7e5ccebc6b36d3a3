#!/bin/sh
# REST with curl: models, a forecast, an error, and live forecasts as Server-Sent Events.
#
#   sh examples/rest/curl.sh [URL]        (http://127.0.0.1:8080)
#
# CAB_FORECAST_TOKEN holds the API key of servers that ask for one.
set -eu
url=${1:-http://127.0.0.1:8080}
scene="curl-$$"
events=$(mktemp)
trap 'rm -f "$events"' EXIT

request() { # PATH [OPTION...]: prints the body, or fails with curl's message if there is no server
  path=$1
  shift
  curl --silent --show-error --max-time 10 ${CAB_FORECAST_TOKEN:+-H "Authorization: Bearer $CAB_FORECAST_TOKEN"} "$@" "$url$path"
}

pretty() {
  if command -v jq >/dev/null; then jq .; else python3 -m json.tool; fi
}

scene_at() { # TIME HORIZON: a request with one vehicle, seen at 2 Hz, at 8 m/s along x
  cat <<JSON
{
  "scene_id": "$scene",
  "time": $1,
  "agents": [{
    "id": "car", "type": "AGENT_TYPE_VEHICLE",
    "states": [
      {"time": $(($1 - 2)), "x": 0, "y": 0},
      {"time": $(($1 - 2)).5, "x": 4, "y": 0},
      {"time": $(($1 - 1)), "x": 8, "y": 0},
      {"time": $(($1 - 1)).5, "x": 12, "y": 0},
      {"time": $1, "x": 16, "y": 0}
    ]
  }],
  "options": {"merge": true, "max_modes": 2, "horizon": $2}
}
JSON
}

predict() { # TIME HORIZON
  # Request-Timeout: the server answers within so many seconds, or with an error
  scene_at "$1" "$2" | request /v1/predict -H 'Content-Type: application/json' -H 'Request-Timeout: 5' --data-binary @-
}

request /livez >/dev/null # stops here if there is no server
now=$(date +%s)

echo "== Models"
request /v1/models/cab | pretty

echo "== A forecast"
predict "$now" 2 | pretty

echo "== An error: problem+json names the field"
scene_at "$now" 2.2 | request /v1/predict -H 'Content-Type: application/json' --data-binary @- \
  --write-out '\n{"http_status": %{http_code}, "content_type": "%{content_type}"}\n' | pretty

echo "== Live forecasts of the scene"
curl --silent --no-buffer --max-time 20 ${CAB_FORECAST_TOKEN:+-H "Authorization: Bearer $CAB_FORECAST_TOKEN"} \
  "$url/v1/scenes/$scene/forecasts/watch" >"$events" &
watcher=$!
tries=0
until [ -s "$events" ] || [ "$tries" -ge 50 ]; do # the first message says that the watch has begun
  tries=$((tries + 1))
  sleep 0.1
done
predict "$((now + 1))" 2 >/dev/null
until grep -q '"frame"' "$events" || [ "$tries" -ge 100 ]; do
  tries=$((tries + 1))
  sleep 0.1
done
kill "$watcher" 2>/dev/null || true
wait "$watcher" 2>/dev/null || true
sed -n 's/^data: //p' "$events" | pretty

echo "== Live scenes"
request /v1/scenes | pretty
