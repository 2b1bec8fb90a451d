#!/bin/sh
# Copies a composed system's database and data into a folder while it runs: deploy/backup.sh FOLDER
# The database is copied first: a job whose folder is newer than its row goes on, but one without a folder starts again.
# DENTINE_COMPOSE is the compose command, by default `docker compose --file deploy/compose.yaml`.
set -eu
folder=${1:?give the folder to write to}
compose=${DENTINE_COMPOSE:-"docker compose --file $(dirname "$0")/compose.yaml"}
umask 077
mkdir -p "$folder"
[ ! -e "$folder/SHA256SUMS" ] || { echo "backup: $folder holds a backup already; give another folder." >&2; exit 2; }
$compose exec -T postgres pg_dump --username dentine --format custom dentine >"$folder/database.dump"
# Stages that are being written have folders whose names begin with a dot. They are left out, because the system itself
# continues or removes them. Status 1 of tar means that a file changed while it was read.
$compose exec -T api sh -c \
    'tar --create --directory /data --exclude "./jobs/*/.*.[0-9]*" --exclude ./lost+found --warning no-file-changed --warning no-file-removed --file - . || [ $? -eq 1 ]' \
    >"$folder/data.tar"
(cd "$folder" && sha256sum database.dump data.tar >SHA256SUMS.partial && mv SHA256SUMS.partial SHA256SUMS)
echo "backup: database and data are in $folder"
