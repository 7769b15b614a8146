#!/bin/sh
# Make the secrets of an installation, once: files in secrets/ beside this, which nobody else may open.
set -eu
cd "$(dirname "$0")"
mkdir -m 700 secrets 2>/dev/null || { echo "secrets/ is there already; remove it only with the installation" >&2; exit 1; }
random() { head -c 32 /dev/urandom | od -An -tx1 | tr -d ' \n'; }
database=$(random) id=isodyn secret=$(random)
printf %s "$database" >secrets/postgres_password
printf 'postgresql+psycopg://isodyn:%s@db/isodyn' "$database" >secrets/isodyn_database_url
printf 'isd_%s' "$(random)" >secrets/isodyn_admin_key
printf 'isd_%s' "$(random)" >secrets/isodyn_metrics_key
printf '[default]\naws_access_key_id = %s\naws_secret_access_key = %s\n' "$id" "$secret" >secrets/aws_credentials
printf '{"identities": [{"name": "isodyn", "credentials": [{"accessKey": "%s", "secretKey": "%s"}], "actions": ["Admin"]}]}\n' \
  "$id" "$secret" >secrets/s3_identities
# The containers run as other users: the folder keeps everybody else out, the files must be readable inside.
chmod 644 secrets/*
echo "made; the admin key is in deploy/compose/secrets/isodyn_admin_key"
