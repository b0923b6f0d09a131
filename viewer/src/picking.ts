/** Decides who receives the next click on the map: usually the panel of the sun at a point, sometimes one that needs a place. */

import type { LngLat, Map as MapLibre } from 'maplibre-gl';

type Taker = (place: LngLat) => void;

let taker: Taker | null = null;

/** Hands the next click on the map to `take`. Returns what ends the waiting. */
export function takeNextClick(map: MapLibre, take: Taker): () => void {
  taker = take;
  map.getCanvas().style.cursor = 'crosshair';
  const end = () => {
    if (taker !== take) return;
    taker = null;
    map.getCanvas().style.cursor = '';
  };
  return end;
}

/** Whether a click was wanted, and has been handed over. */
export function handOver(map: MapLibre, place: LngLat): boolean {
  const take = taker;
  if (!take) return false;
  taker = null;
  map.getCanvas().style.cursor = '';
  take(place);
  return true;
}
