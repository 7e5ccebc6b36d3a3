#!/bin/sh
# Make the secrets of docker-compose.yml in ./secrets: sh deploy/secrets.sh [--allow-anyone]
# Existing ones are left alone. --allow-anyone: the servers need no keys, for a network where everyone may call.
set -eu
umask 077
cd "$(dirname "$0")/.."
mkdir -p secrets/forecast
[ -x .venv/bin/cab-forecast ] && PATH=$PWD/.venv/bin:$PATH
random() { od -An -N24 -tx1 /dev/urandom | tr -d ' \n'; }

if [ ! -e secrets/redis.conf ]; then
  password=$(random)
  printf 'requirepass %s\n' "$password" > secrets/redis.conf
  printf 'store = "redis://:%s@redis:6379"\n' "$password" > secrets/forecast/forecast.toml
  if [ "${1:-}" = --allow-anyone ]; then
    echo 'allow_anyone = true' >> secrets/forecast/forecast.toml
    echo none > secrets/metrics_key
    echo none > secrets/client_key
  else
    echo 'keys_file = "/etc/cab-forecast/keys.json"' >> secrets/forecast/forecast.toml
    keys="${CAB_FORECAST:-cab-forecast} keys add --file secrets/forecast/keys.json"
    $keys prometheus --scope metrics > secrets/metrics_key
    $keys me > secrets/client_key
    echo "The key of your calls is in secrets/client_key."
  fi
fi
[ -e secrets/grafana_password ] || random > secrets/grafana_password
# Containers read them as users of their own; the folder itself is yours alone.
chmod 755 secrets/forecast
chmod 644 secrets/*_* secrets/redis.conf secrets/forecast/*
