// SPDX-License-Identifier: Apache-2.0
// The line to the node: states and track as they come, and whether it lives.

const SILENT_MS = 5000; // the node speaks every second
const AGAIN_MS = 3000;

export class Link {
  // hear(state), hearTrack({begin, points}), hearFull(places)
  constructor(handlers) {
    this.handlers = handlers;
    this.heardAt = -Infinity;
  }

  get alive() {
    return performance.now() - this.heardAt < SILENT_MS;
  }

  close() {
    clearTimeout(this.timer);
    this.source?.close();
  }

  open() {
    this.close();
    const source = new EventSource("/events");
    this.source = source;
    source.addEventListener("state", (event) => {
      this.heardAt = performance.now();
      this.handlers.hear(JSON.parse(event.data));
    });
    source.addEventListener("track", (event) => this.handlers.hearTrack(JSON.parse(event.data)));
    source.addEventListener("full", (event) => this.handlers.hearFull(Number(event.data)));
    source.addEventListener("error", () => {
      if (source.readyState !== EventSource.CLOSED) return; // the browser comes again by itself
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.open(), AGAIN_MS);
    });
  }
}
