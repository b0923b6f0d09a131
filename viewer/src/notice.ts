/** Message over the map about a request that cannot be met. It stays until the user closes it or something else is shown. */

import { byId } from './dom';

/** Says it; null takes it away. */
export function notice(words: string | null): void {
  const box = byId('notice');
  const close = box.querySelector('button');
  if (close) close.onclick = () => notice(null);
  box.hidden = words === null;
  box.querySelector('p')?.replaceChildren(words ?? '');
}
