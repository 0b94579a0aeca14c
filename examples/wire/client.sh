#!/usr/bin/env bash
# The wire of the twin in plain bash: no flexdt, no nc, no jq on this side.
#
#   examples/wire/client.sh [HOST [PORT]]
#
# Takes a sample, turns the stage by 90 degrees, waits for it, and writes a projection's float32
# pixels (little-endian, row by row) to projection.raw. Fields are picked out of the answers with
# sed, which is enough for numbers and text without quotes; use jq where there is one.
set -euo pipefail
host=${1:-127.0.0.1} port=${2:-55000} count=0

exec 3<>"/dev/tcp/$host/$port"   # one connection, read and written through descriptor 3

# call METHOD PARAMS -> the whole answer in $answer; leaves with the server's words on an error.
call() {
  count=$((count + 1))
  printf '{"jsonrpc":"2.0","id":%d,"method":"%s","params":%s}\n' "$count" "$1" "$2" >&3
  while IFS= read -r answer <&3; do
    case $answer in
      *'"method":"event"'*) continue ;;             # events come between answers
      *'"error":'*) echo "$1: $answer" >&2; exit 1 ;;
      *) return 0 ;;
    esac
  done
  echo "the server closed the connection" >&2
  exit 4
}

# number NAME -> the first number called NAME in $answer.
number() { sed -n "s/.*\"$1\":\(-\{0,1\}[0-9.eE+-]*\).*/\1/p" <<<"$answer"; }

call session.hello '{"protocol":"1.0","client":"shell"}'
call sample.set '{"name":"normal-5"}'
call axes.move '{"targets":{"rot_obj":0,"tra_obj":0,"mag_obj":600},"wait":true}'
call axes.move '{"targets":{"rot_obj":90},"wait":true}'
echo "the turn took $(number duration_s) s of the twin's time"

call projection.get '{"kind":"line_integral","binning":4}'
shape=$(sed -n 's/.*"shape":\[\([0-9, ]*\)\].*/\1/p' <<<"$answer")
sed -n 's/.*"data":"\([^"]*\)".*/\1/p' <<<"$answer" | base64 -d > projection.raw
echo "projection.raw: float32, rows x columns = ${shape/,/ x }"
