/** The shared worker that holds the one stream of events of a browser. */

import { EventHub, type PageMessage } from "./eventHub";

const hub = new EventHub();

addEventListener("connect", (event) => {
  const port = (event as MessageEvent).ports[0];
  if (port)
    port.onmessage = (message: MessageEvent<PageMessage>) =>
      hub.handle(port, message.data, (reply) => port.postMessage(reply));
});
