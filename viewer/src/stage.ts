/** Area for levels without a place on earth: pictures of their views instead of a map. */

import { html } from './dom';
import { type Level, type Service, isPlaced } from './service';
import type { State, Store } from './state';
import { Picture, snapshotQuery } from './views/snapshot';
import { viewTitle } from './views/titles';
import './stage.css';

/** Views of a level that can be drawn, the first of which it opens with. Every level can be seen from above. */
export function shotsOf({ views, view_kinds: kinds }: Pick<Level, 'views' | 'view_kinds'>): readonly string[] {
  const drawn = views.filter((name) => kinds[name]?.size);
  return drawn.length ? drawn : ['map'];
}

export function whyNoMap(level: Pick<Level, 'sun'>): string {
  return `This level is not georeferenced: there is no map of it${level.sun ? ', and no sun by date and time' : ''}. These are its views.`;
}

export class Stage {
  readonly #why = html('p', { class: 'why' });
  readonly #choice = html('fieldset', { class: 'choice' });
  readonly #shot = html('div', { class: 'shot' });
  #picture: Picture | null = null;

  /** `busy` hears when a picture is asked for, and when it is there or is not to be had; `failed` why. */
  constructor(
    private readonly place: HTMLElement, private readonly service: Service, private readonly store: Store,
    private readonly busy: (waits: boolean) => void, private readonly failed: (words: string) => void,
  ) {
    place.append(html('div', { class: 'card head' }, this.#why, this.#choice), this.#shot);
  }

  /** Makes room for the views of a level; one with a place has a map, and no stage. */
  open(level: Level): void {
    this.#picture?.close();
    this.#picture = null;
    this.place.hidden = isPlaced(level);
    document.body.classList.toggle('flat', !isPlaced(level));
    if (isPlaced(level)) return;
    this.#why.textContent = whyNoMap(level);
    const shots = shotsOf(level);
    this.#choice.hidden = shots.length < 2;
    this.#choice.replaceChildren(html('legend', { class: 'unseen' }, 'View'), ...shots.map((name) => html('label', {},
      html('input', { type: 'radio', name: 'shot', value: name, onchange: () => this.store.set({ shot: name }) }), html('span', {}, viewTitle(name)))));
    this.#picture = new Picture(this.service, '');
    this.#shot.replaceChildren(this.#picture.element);
  }

  /** Draws the view of a state; resolves with whether that is what is seen then. */
  async draw(level: Level, state: State): Promise<boolean> {
    const view = state.shot ?? shotsOf(level)[0] ?? 'map';
    for (const input of this.#choice.querySelectorAll('input')) input.checked = input.value === view;
    const picture = this.#picture;
    if (!picture) return false;
    const address = this.service.of(level.name, 'snapshot.png', { view, size: this.#sizeOf(level, view), ...snapshotQuery(state) });
    picture.describe(`${viewTitle(view)} · ${level.title || level.name}`);
    this.busy(true);
    const shown = await picture.show(address);
    if (shown !== null) this.busy(false);
    if (shown === false) this.failed(picture.words);
    return shown === true;
  }

  /** As many pixels as are seen of a view, in its own proportions; null: as many as it has. */
  #sizeOf({ view_kinds: kinds }: Level, view: string): string | null {
    const [width, height] = kinds[view]?.size ?? [0, 0];
    const { clientWidth, clientHeight } = this.#shot;
    const scale = Math.min(clientWidth / width, clientHeight / height) * window.devicePixelRatio;
    return scale > 0 && scale < 1 ? `${Math.round(width * scale)}x${Math.round(height * scale)}` : null;
  }
}
