/** Message over the map if nothing can be shown: what is wrong, and a link back. */

import { byId, html } from './dom';

export interface Way {
  readonly words: string;
  go(): void;
}

let shown = '';

/** Says something over the map, with a way on; null takes it away. `over`: the map cannot be used below it. */
export function veil(words: string | null, way?: Way, over = false): void {
  const place = byId('veil');
  const key = JSON.stringify([words, way?.words, over]);
  if (key === shown) return;
  shown = key;
  place.hidden = words === null;
  place.classList.toggle('over', over);
  place.replaceChildren(...(words === null ? [] : [html('div', {
    class: 'card', role: 'status',
  }, html('p', {}, words), way && html('button', { type: 'button', onclick: () => way.go() }, way.words))]));
}
