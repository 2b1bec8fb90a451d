# Stands in for the public Postgres image where none can be pulled: Debian's server behind the same variables, folders
# and users.
ARG PYTHON_IMAGE
FROM ${PYTHON_IMAGE}
RUN mkdir -p /usr/share/man/man1 /usr/share/man/man7 && apt-get update -qq && apt-get install -qq -y --no-install-recommends postgresql && apt-get clean && rm -rf /var/lib/apt/lists/* \
 && install -d -o postgres -g postgres -m 1777 /var/lib/postgresql/data
COPY postgres-entrypoint.sh /usr/local/bin/
ENTRYPOINT ["/usr/local/bin/postgres-entrypoint.sh"]
