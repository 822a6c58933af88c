// SPDX-License-Identifier: Apache-2.0
'use strict';

/*
 * Connection of the page to `needle watch`: messages, its clock, and interruptions. The server
 * sends its clock four times a second, also without frames.
 */
const needleConnection = (() => {
  /* Time without a message that is an interruption, and period of the check [ms]. */
  const SILENCE = 1000, CHECK = 200;
  /* Close code of a server with too many pages. */
  const TRY_AGAIN_LATER = 1013;

  class Connection {
    /* `take` is called with each message, `changed` if the connection may have changed. */
    constructor(url, take, changed) {
      this.url = url;
      this.take = take;
      this.changed = changed;
      this.open = false;
      this.refused = '';  /* reason of the server */
      this.clock = null;  /* newest time of the server, and that of its arrival */
      this.heard = performance.now();
      this.connect();
      setInterval(() => this.open && this.silence() && changed(), CHECK);
    }

    connect() {
      const socket = new WebSocket(this.url);
      this.socket = socket;
      socket.addEventListener('open', () => {
        this.open = true;
        this.clock = null;
        this.heard = performance.now();
        this.changed();
      });
      socket.addEventListener('message', (event) => {
        const silent = this.silence(), message = JSON.parse(event.data);
        this.heard = performance.now();
        const first = this.clock === null && 'clock' in message;
        if ('clock' in message) this.clock = [message.clock, this.heard];
        if (silent || first) this.changed();
        this.take(message);
      });
      socket.addEventListener('close', (event) => {
        this.open = false;
        if (event.code === TRY_AGAIN_LATER) this.refused = event.reason;
        else setTimeout(() => this.connect(), 1000);
        this.changed();
      });
    }

    /* Send a message; return false if it cannot be sent. */
    send(message) {
      if (this.open) this.socket.send(JSON.stringify(message));
      return this.open;
    }

    /* Time without a message [s], 0 if it is short. */
    silence() {
      const time = performance.now() - this.heard;
      return time > SILENCE ? time / 1e3 : 0;
    }

    /* Present time of the server [s], as far as it is known. */
    now() {
      return this.clock === null ? null : this.clock[0] + (performance.now() - this.clock[1]) / 1e3;
    }

    /* What is wrong with the connection, '' if nothing is. */
    trouble() {
      if (this.refused) return this.refused;
      if (!this.open) return 'not connected: needle watch has ended or is not reachable';
      return this.silence() ? `no data for ${Math.floor(this.silence())} s` : '';
    }
  }

  return {Connection};
})();
