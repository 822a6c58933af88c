# SPDX-License-Identifier: Apache-2.0
# All nodes, the program `needle`, and its functions compiled for x86-64-v3: docs/howto/install.md.
FROM python:3.12-bookworm

COPY . /src
RUN python -m pip install --no-cache-dir '/src[ros]' \
    && needle compile --portable \
    && rm -rf /src

# Not root: the compiled functions are shared, new ones are written to the home of the user.
RUN useradd --create-home needle && install -d -o needle /data
USER needle
WORKDIR /data
ENTRYPOINT ["needle"]
CMD ["--help"]
