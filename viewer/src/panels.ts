/** Panels beside the map, one of which is open. Each panel is a module, and knows the page by its context only. */

import type { Map as MapLibre } from 'maplibre-gl';

import type { BaseMaps } from './base_maps';
import type { Level, Service } from './service';
import type { State, Store } from './state';

/** What a panel may use. */
export interface PanelContext {
  readonly store: Store;
  /** MapLibre's map. Sources and layers that a panel adds stay when the shaded layer changes; it takes them away itself. */
  readonly map: MapLibre;
  readonly service: Service;
  readonly baseMaps: BaseMaps;
  /** All levels, also those without a place on the earth. */
  readonly levels: readonly Level[];
  /** The level that is shown; one without a place only to panels that need no map. */
  level(): Level;
  /** Opens a panel, and on a phone the sheet that it lies on. */
  open(id: string): void;
  /** Says something in a line to everybody, screen readers included. */
  announce(words: string): void;
}

/**
 * A panel keeps what belongs into the address in `store.setOwn({name: text})` and reads it from `store.state.own`; names are its own
 * id, or begin with it and a hyphen.
 */
export interface Panel {
  /** As in the address: `panel=point`. */
  readonly id: string;
  /** On its tab: a word. */
  readonly title: string;
  /** Whether it is there for levels without a place on the earth, too. */
  readonly needsNoMap?: boolean;
  /** What of its parts of the address means nothing, in words. */
  faults?(own: State['own']): string[];
  /** Once, when the map is there: to hear clicks on the map and the like while the panel is closed. */
  start?(context: PanelContext): void;
  /** Whenever the panel opens. Returns what takes it away again. */
  mount(container: HTMLElement, context: PanelContext): () => void;
}

const registered: Panel[] = [];

/** Adds a panel after those that there are. */
export function registerPanel(panel: Panel): void {
  if (registered.some(({ id }) => id === panel.id)) throw new Error(`panel: there are two named '${panel.id}'`);
  registered.push(panel);
}

export function panels(): readonly Panel[] {
  return registered;
}
