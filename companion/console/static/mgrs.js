// WGS84 to MGRS at one metre (NGA.STND.0037): transverse Mercator by Krüger's series.
const A = 6378137.0, F = 1 / 298.257223563, K0 = 0.9996;
const BANDS = "CDEFGHJKLMNPQRSTUVWX";

export function utm(latitude, longitude) {
  let zone = Math.floor((longitude + 180) / 6) + 1;
  if (latitude >= 56 && latitude < 64 && longitude >= 3 && longitude < 12) zone = 32;
  if (latitude >= 72 && latitude < 84) {
    if (longitude >= 0 && longitude < 9) zone = 31;
    else if (longitude >= 9 && longitude < 21) zone = 33;
    else if (longitude >= 21 && longitude < 33) zone = 35;
    else if (longitude >= 33 && longitude < 42) zone = 37;
  }
  zone = Math.min(Math.max(zone, 1), 60);
  const n = F / (2 - F), phi = (latitude * Math.PI) / 180, lambda = ((longitude - (6 * zone - 183)) * Math.PI) / 180;
  const radius = (A / (1 + n)) * (1 + n ** 2 / 4 + n ** 4 / 64);
  const alpha = [n / 2 - (2 / 3) * n ** 2 + (5 / 16) * n ** 3, (13 / 48) * n ** 2 - (3 / 5) * n ** 3, (61 / 240) * n ** 3];
  const s = (2 * Math.sqrt(n)) / (1 + n);
  const t = Math.sinh(Math.atanh(Math.sin(phi)) - s * Math.atanh(s * Math.sin(phi)));
  const xi = Math.atan2(t, Math.cos(lambda)), eta = Math.atanh(Math.sin(lambda) / Math.sqrt(1 + t * t));
  let east = eta, north = xi;
  alpha.forEach((a, i) => {
    const j = 2 * (i + 1);
    east += a * Math.cos(j * xi) * Math.sinh(j * eta);
    north += a * Math.sin(j * xi) * Math.cosh(j * eta);
  });
  return { zone, east: 500000 + K0 * radius * east, north: K0 * radius * north + (latitude < 0 ? 10000000 : 0) };
}

export function toMgrs(latitude, longitude) {
  if (latitude < -80 || latitude > 84) return "-";
  const { zone, east, north } = utm(latitude, longitude);
  const band = BANDS[Math.min(Math.floor((latitude + 80) / 8), 19)];
  const columns = ["STUVWXYZ", "ABCDEFGH", "JKLMNPQR"][zone % 3];
  const column = columns[Math.floor(east / 100000) - 1];
  const rows = zone % 2 ? "ABCDEFGHJKLMNPQRSTUV" : "FGHJKLMNPQRSTUVABCDE";
  const row = rows[Math.floor(north / 100000) % 20];
  const digits = (value) => String(Math.floor(value % 100000)).padStart(5, "0");
  return `${zone}${band} ${column}${row} ${digits(east)} ${digits(north)}`;
}
