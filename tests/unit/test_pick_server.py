"""Who may ask the page's server, and what it serves: nothing but the photos of the object and its scene."""

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect
from support.user_project import Project

from scenefuse.pick.pick import Entrance, Guard, add_pictures
from scenefuse.pick.session import Session

PORT = 8123
HERE = f"http://127.0.0.1:{PORT}"


@pytest.fixture
def session(tmp_path, monkeypatch):
    project = Project(tmp_path)
    project.photos("flight", 2)
    project.photos("close", 3)
    cv2.imwrite(str(tmp_path / "close/Füße und Kopf.jpg"), np.zeros((300, 700, 3), dtype=np.uint8))
    (tmp_path / "secret.jpg").write_bytes((tmp_path / "close/0.jpg").read_bytes())
    project.write()
    monkeypatch.chdir(tmp_path)
    return Session("shed", (tmp_path / "mine.yaml",))


@pytest.fixture
def entrance(tmp_path):
    return Entrance(PORT, tmp_path / "results/pick/open.html", lambda _: None)


@pytest.fixture
def client(session, entrance):
    app = FastAPI()
    app.add_middleware(Guard, entrance=entrance, key=session.key, port=PORT)
    add_pictures(app, session)

    @app.get("/")
    def page() -> str:
        return "the page, with its key"

    @app.websocket("/socket")
    async def socket(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.send_text("hello")
        await websocket.close()

    with TestClient(app, base_url=HERE) as client:
        yield client


def token(entrance):
    return entrance.address.split("#")[1]


def enter(client, given):
    return client.post("/enter", headers={"x-scenefuse": given})


@pytest.fixture
def key(session):
    return {"key": session.key}


@pytest.mark.parametrize("address", ["/tile/0/0/0/0/0", "/thumbnail/0/0", "/thumbnail/0/0?key=é", "/_nicegui/client/1"])
def test_without_a_secret_nothing_of_the_project_is_served(client, session, entrance, address):
    refused = client.get(address)
    assert refused.status_code == 403 and session.key not in refused.text
    door = client.get("/")
    assert door.status_code == 200 and not {session.key, entrance.secret, token(entrance)} & set(door.text.split('"'))
    assert client.get("/", headers={"x-scenefuse": token(entrance)}).status_code == 403


def test_a_token_leads_in_once_and_the_next_one_is_in_a_file_of_this_user_alone(client, entrance):
    first = token(entrance)
    assert first in entrance.file.read_text() and entrance.file.stat().st_mode & 0o777 == 0o600
    assert enter(client, "wrong").status_code == 403
    secret = enter(client, first).text
    assert client.get("/", headers={"x-scenefuse": secret}).json() == "the page, with its key"
    assert enter(client, first).status_code == 403
    assert first not in entrance.file.read_text() and token(entrance) in entrance.file.read_text()
    assert entrance.file.stat().st_mode & 0o777 == 0o600
    entrance.close()
    assert not entrance.file.exists()


def test_nothing_is_kept_in_a_cookie_which_every_port_of_this_machine_would_get(client, entrance, key):
    answers = [enter(client, token(entrance)), client.get("/"), client.get("/thumbnail/0/0", params=key)]
    answers.append(client.get("/", headers={"x-scenefuse": answers[0].text}))
    assert [answer.status_code for answer in answers] == [200] * 4
    assert not [answer for answer in answers if "set-cookie" in answer.headers]


def test_no_page_of_another_server_can_frame_this_one(client, key):
    for answer in (client.get("/"), client.get("/thumbnail/0/0", params=key), client.get("/thumbnail/0/0")):
        assert answer.headers["content-security-policy"] == "frame-ancestors 'none'"
        assert answer.headers["x-frame-options"] == "DENY" and answer.headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    "header", [{"host": f"evil.example:{PORT}"}, {"origin": "http://evil.example"}, {"origin": "http://127.0.0.1:9"}]
)
def test_other_names_and_other_ports_are_refused_even_with_the_secrets(client, entrance, key, header):
    assert client.get("/thumbnail/0/0", params=key, headers=header).status_code == 403
    assert client.post("/enter", headers=header | {"x-scenefuse": token(entrance)}).status_code == 403


def test_a_websocket_needs_the_key_of_the_page_and_its_own_site(client, entrance, session):
    headers = {"host": f"127.0.0.1:{PORT}", "x-scenefuse": entrance.secret}
    for path in ("/socket", "/socket?key=wrong", f"/socket?key={entrance.secret}"):
        with pytest.raises(WebSocketDisconnect), client.websocket_connect(path, headers=headers):
            pass
    with client.websocket_connect(f"/socket?key={session.key}", headers=headers) as socket:
        assert socket.receive_text() == "hello"
    evil = headers | {"origin": "http://127.0.0.1:9"}
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"/socket?key={session.key}", headers=evil):
        pass


@pytest.mark.parametrize(
    "address",
    [
        "/thumbnail/0/../../secret.jpg",
        "/thumbnail/0/%2e%2e%2f%2e%2e%2fsecret.jpg",
        "/thumbnail/0/secret.jpg",
        "/tile/0/..%2f..%2f..%2fetc%2fpasswd/0/0/0",
        "/tile/0//etc/passwd",
        "/secret.jpg",
        "/close/0.jpg",
        "/thumbnail/0/-1",
        "/thumbnail/0/4",
        "/thumbnail/3/0",
        "/thumbnail/-1/0",
        "/tile/0/0/0/1/0",
    ],
)
def test_no_address_leads_out_of_the_photos(client, key, address):
    assert client.get(address, params=key).status_code in (404, 422)


def test_photos_with_spaces_and_umlauts_are_served(client, session, key):
    number = list(session.tables[0].pictures).index("Füße und Kopf.jpg")
    tile = client.get(f"/tile/0/{number}/2/2/1", params=key)
    assert tile.status_code == 200 and cv2.imdecode(np.frombuffer(tile.content, np.uint8), 1).shape == (256, 256, 3)
    thumbnail = client.get(f"/thumbnail/0/{number}", params=key)
    assert cv2.imdecode(np.frombuffer(thumbnail.content, np.uint8), 1).shape == (137, 320, 3)


def test_a_photo_that_vanished_is_not_found(client, session, key):
    for picture in session.tables[0].pictures.values():
        picture.path.unlink()
    for address in ("/thumbnail/0/0", "/tile/0/0/0/0/0"):
        assert client.get(address, params=key).status_code == 404
