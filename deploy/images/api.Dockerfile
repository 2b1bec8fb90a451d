# The API and its dashboard: no renderer; of the capture what switches the dome by hand.
FROM node:22-bookworm-slim AS dashboard
WORKDIR /dashboard
COPY services/api/dashboard/package.json services/api/dashboard/package-lock.json services/api/dashboard/tsconfig.json ./
RUN npm ci --silent
COPY services/api/dashboard/src src
RUN npm run --silent build

FROM python:3.12-slim-bookworm
RUN useradd --uid 10001 --create-home dentine && install -d -o dentine -g dentine /data
WORKDIR /app
COPY pyproject.toml README.md ./
COPY services services
COPY --from=dashboard /dashboard/static services/api/dashboard/static
RUN pip install --no-cache-dir '.[api,postgres,capture]'
USER dentine
VOLUME /data
CMD ["dentine", "serve"]
