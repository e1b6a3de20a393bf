# The service in a container:
#   docker build -t cairn .
#   docker run --rm -v cairn-data:/data cairn key create me --scope manage --all-projects
#   docker run -p 8080:8080 -v cairn-data:/data cairn
# Settings are environment variables (README, "Settings"). All state is in the volume /data.

FROM rust:1.95-slim-trixie AS build
WORKDIR /src
COPY . .
# The image has the C compiler that SQLite and the allocator are built with. The caches outlive the layer, the binary does not
# live in them: it is copied out, without the line tables that only a debugger reads.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/src/target \
    cargo build --release --locked --bin cairn \
    && strip --strip-debug -o /cairn target/release/cairn \
    && mkdir /empty

FROM debian:trixie-slim
# Whom webhooks by https are believed.
COPY --from=build /etc/ssl/certs/ca-certificates.crt /etc/ssl/certs/ca-certificates.crt
COPY --from=build /cairn /usr/local/bin/cairn
COPY LICENSE-MIT LICENSE-APACHE /usr/share/doc/cairn/
# A new volume takes over owner and mode of the directory it is mounted on.
COPY --from=build --chown=10001:10001 /empty /data
VOLUME /data
USER 10001:10001
ENV CAIRN_LISTEN=0.0.0.0:8080 CAIRN_DATA=/data
EXPOSE 8080
# SIGTERM shuts down softly: jobs that are not done are given back to the queue. `docker stop -t 40` gives it the time; being
# killed earlier loses nothing either.
STOPSIGNAL SIGTERM
# bash is in the base image and can open the socket itself. It asks without TLS at port 8080: where settings say otherwise, give
# `--no-healthcheck` or a check of your own.
HEALTHCHECK --interval=30s --timeout=5s --start-period=10s \
    CMD ["bash", "-c", "exec 3<>/dev/tcp/127.0.0.1/8080 && printf 'GET /readyz HTTP/1.0\\r\\n\\r\\n' >&3 && read -r _ status _ <&3 && [ \"$status\" = 200 ]"]
ENTRYPOINT ["cairn"]
CMD ["serve"]
