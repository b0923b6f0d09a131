/** Access to the second map of a comparison, on which the player also plays the day. */

import type { Map as MapLibre } from 'maplibre-gl';

import type { Query } from './service';
import type { State } from './state';

export interface ComparedMap {
  readonly map: MapLibre;
  /** What its tiles are asked for in a state of the page. */
  query(state: State): Query;
  /** Keeps its own tiles as they are while pictures of a day lie over them. */
  hold(): void;
  /** Shows the tiles of the present again; resolves when they are drawn. */
  release(): Promise<void>;
}

let present: ComparedMap | null = null;

/** Says which map is compared; null: none is. */
export function setComparedMap(compared: ComparedMap | null): void {
  present = compared;
}

/** The map that is compared, once it can be drawn on. */
export function comparedMap(): ComparedMap | null {
  return present;
}
