#!/bin/sh
# Replaces database and data of a composed system by those of a backup: deploy/restore.sh FOLDER
# Stops the system, replaces database and data, and starts it again. DENTINE_COMPOSE as for backup.sh.
set -eu
folder=$(cd "${1:?give the folder of the backup}" && pwd)
compose=${DENTINE_COMPOSE:-"docker compose --file $(dirname "$0")/compose.yaml"}
(cd "$folder" && sha256sum --quiet --check SHA256SUMS) || { echo "restore: the backup in $folder is damaged; nothing was changed." >&2; exit 5; }
$compose stop api worker rig
$compose up --detach --wait postgres
$compose exec -T postgres dropdb --username dentine --if-exists --force dentine
$compose exec -T postgres createdb --username dentine dentine
$compose exec -T postgres pg_restore --username dentine --dbname dentine --exit-on-error <"$folder/database.dump"
$compose run --rm --no-deps -T api find /data -mindepth 1 -maxdepth 1 -not -name lost+found -exec rm -rf {} +
$compose run --rm --no-deps -T api tar --extract --directory /data --file - <"$folder/data.tar"
$compose up --detach
echo "restore: done; jobs that were under way go on from what they had published"
